"""Live targets: where they come from, which of them are taken, and the other end for a policy."""
