"""Processes that gaponet starts, and what they may."""
