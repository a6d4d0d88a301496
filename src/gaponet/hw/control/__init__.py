"""The loop between a target and a robot: controller, limits, watchdog, recording."""
