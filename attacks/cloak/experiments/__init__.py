"""Experiments that explain a figure of a CLOAK study; each is a subcommand of `mi-splat cloak-experiment`."""
