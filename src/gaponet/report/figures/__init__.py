"""Figures: style, charts, and what is drawn of datasets, gaps and evaluations."""
