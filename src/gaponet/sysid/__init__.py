"""System identification: fit, calibration, torque, uncertainty, drift, and motions worth recording."""
