"""Setting up a robot folder: making one from a vendor's model, and checking that it simulates what it should."""
