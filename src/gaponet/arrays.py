"""What annotations call an array; docstrings say its shape and unit."""

from __future__ import annotations

import numpy as np

Array = np.ndarray
