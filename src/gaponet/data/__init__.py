"""Logs to datasets: Log → Sequence → Pair → PairedDataset, and the folder they live in."""
