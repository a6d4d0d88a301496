"""Commands that compare trainings."""
