"""The operator: one observation, sensors, branch and trunk, baselines, and the artifact that ships."""
