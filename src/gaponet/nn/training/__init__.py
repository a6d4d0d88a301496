"""Training: environment, sensor fit, warm start, PPO. Nothing that may run on a robot imports it."""

import os

# torch's threads and the simulator's take turns on the same cores: one that waits must not spin (a factor of five).
# torch reads this when it is first imported.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
