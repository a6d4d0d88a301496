"""Families of simulators: drawn around a nominal one, and how a model knows which of them it is in."""
