"""Evidence of recordings about parameters: their uncertainty, and whether a robot has changed."""
