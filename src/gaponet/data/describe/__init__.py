"""Meaning of logs: logs.toml describes columns, units, signs and clocks, and the log becomes a
Log.
"""
