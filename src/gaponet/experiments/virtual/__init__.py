"""Experiments in which a virtual unit executes motions under the commands of trained models."""
