"""Studies of DAGGER as artifacts: many attacks, whose raw rows lie in the same tables."""
