"""What is known of a robot: how sure its values are, and whether later logs are still of it."""
