"""What a user does with a model on a robot: aligned simulator, compensator, controller, drivers."""
