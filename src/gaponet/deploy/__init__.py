"""Using a trained model: aligned simulator, compensator, the loop on a robot."""
