"""Evaluation of what ships on recordings it never saw, its tables, figures and pages, and the viewer."""
