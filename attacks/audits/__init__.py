"""What the gate finds in a splat file."""
