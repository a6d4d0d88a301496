"""Stepping: MJCF to model, many simulations at once, replay of logged commands."""
