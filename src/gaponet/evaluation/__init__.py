"""Evaluation of simulators on recordings they never saw: errors, gap by cause, candidates,
verdicts, their tables.
"""
