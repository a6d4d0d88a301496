"""Use of a model: aligned simulator, MuJoCo loop, transfer, compensator, gymnasium."""
