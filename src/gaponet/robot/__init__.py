"""Robots: robot.toml and MJCF, robot folders, vendors' models, collision shapes."""
