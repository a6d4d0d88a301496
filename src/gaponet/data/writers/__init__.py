"""Datasets out again: one file per format that others read. A writer loses nothing that its format can hold."""
