"""How good a detector is on held-out pictures of this project: what it finds, what it misses, what it imagines."""
