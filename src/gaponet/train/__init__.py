"""Training: environment, sensor fit, warm start, PPO. The only place, with model/, that imports torch."""
