"""Studies of what becomes of DAGGER when an attacked splat is rendered otherwise than the attacker rendered it."""
