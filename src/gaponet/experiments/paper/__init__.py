"""The paper's experiment: `gaponet experiment paper`. experiment.py reads from top to bottom."""
