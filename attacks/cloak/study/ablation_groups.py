"""What `mi-splat cloak --vary` can vary; light, so that the command line's help needs nothing else."""

from __future__ import annotations

from typing import Literal

AblationGroup = Literal[
    "sh_degree",
    "poison_fraction",
    "appearance",
    "strategy",
    "emphasis",
    "iterations",
    "max_gaussians",
    "outliers",
    "points",
    "cameras",
    "cleaning",
    "object",
]
"""See `attacks.cloak.study.ablations.varied`."""
