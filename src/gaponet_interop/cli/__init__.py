"""Commands that hand over to others."""
