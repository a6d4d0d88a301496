"""Logs to datasets: Log → Sequence → Pair, and the folder they live in."""
