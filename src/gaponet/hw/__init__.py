"""Robots in motion: controller, limits, watchdog, drivers, live targets."""
