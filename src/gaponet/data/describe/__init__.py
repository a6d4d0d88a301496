"""What a log means: logs.toml says of its columns, units, signs and clocks; it becomes a Log."""
