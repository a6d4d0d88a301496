"""Networks: observation, sensors, operator, baselines, the loop around them, the artifact that
ships, training.
"""
