"""Robots with hidden physics: the test bench.

What they give is marked virtual; nothing that learns may look inside.
"""
