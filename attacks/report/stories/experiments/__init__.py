"""What `mi-splat cloak-experiment` leaves behind: one reader for each experiment."""
