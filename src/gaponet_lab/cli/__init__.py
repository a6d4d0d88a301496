"""Commands that show and prove."""
