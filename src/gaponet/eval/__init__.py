"""Measuring what ships, in a stepped simulator, against logs it never saw; and showing it."""
