"""Exports to other simulators: MJCF, URDF, configurations, action terms, actuator networks, randomisation."""
