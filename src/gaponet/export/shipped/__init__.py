"""Files that are copied into exports; they need no gaponet there."""
