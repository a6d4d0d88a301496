"""Export identified robots and trained networks to other engines."""
