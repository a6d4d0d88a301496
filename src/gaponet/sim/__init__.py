"""Simulation: MJCF to model, many simulations at once, replay of recorded commands and its
errors.
"""
