"""Training: environment, sensor fit, supervised pre-training, PPO.

Nothing that may run on a robot imports it.
"""

import os

# The threads of torch and of the simulator use the same cores in turn. Waiting threads must not
# spin, which makes training five times slower. torch reads this variable at its first import.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
