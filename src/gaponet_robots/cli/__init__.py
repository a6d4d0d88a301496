"""Commands that play motions on robots, real or virtual."""
