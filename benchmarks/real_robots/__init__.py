"""Benchmark on public recordings of real robots: data cards, fixed splits, and one table."""
