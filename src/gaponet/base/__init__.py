"""Shared by all sub-packages: errors, files, validation, text, progress, executors and the
sandbox.
"""
