"""System identification: fit, adaptation, torque, uncertainty, drift, and motions worth
recording.
"""
