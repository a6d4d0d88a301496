"""Pages and figures about datasets, gaps and runs."""
