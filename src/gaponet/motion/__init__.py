"""Commands worth playing: excitation per joint, coordinated upper body, whole body, motion
files.
"""
