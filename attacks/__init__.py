"""Everything adversarial: detectors, objectives, budgets, attacks, evaluation.

Imports mi_splat, never the reverse.

The names below are imported when they are first used, so that importing this package is
light, as `--help` needs it. docs/api.md shows how they fit together, docs/plug-ins.md
how to bring a detector, an objective or more of your own.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from mi_splat import _lazy

if TYPE_CHECKING:
    from attacks.cloak.poisoning import Poisoning, poison
    from attacks.cloak.triggers import Azimuth, Cap, Elevation
    from attacks.dagger.attack import attack
    from attacks.dagger.config import DaggerConfig
    from attacks.dagger.report import write_report
    from attacks.dagger.result import Result
    from attacks.dagger.views import ViewDistribution
    from attacks.detectors import Detector, load_detector, wrap_detector
    from attacks.objectives.base import Objective
    from attacks.objectives.function import objective
    from attacks.objectives.relabel import relabel
    from attacks.objectives.suppression import hide, untargeted
    from attacks.observe.comparison import evaluate
    from attacks.observe.rows import rows
    from attacks.search.budget import Budget
    from attacks.search.loop import pgd
    from attacks.studies.running import run_study
    from attacks.transformations.config import Transformations

__all__ = [
    "Azimuth",
    "Budget",
    "Cap",
    "DaggerConfig",
    "Detector",
    "Elevation",
    "Objective",
    "Poisoning",
    "Result",
    "Transformations",
    "ViewDistribution",
    "attack",
    "evaluate",
    "hide",
    "load_detector",
    "objective",
    "pgd",
    "poison",
    "relabel",
    "rows",
    "run_study",
    "untargeted",
    "wrap_detector",
    "write_report",
]

__getattr__, __dir__ = _lazy.attach(
    __name__,
    {
        "attacks.cloak.poisoning": ("Poisoning", "poison"),
        "attacks.cloak.triggers": ("Azimuth", "Cap", "Elevation"),
        "attacks.dagger.attack": ("attack",),
        "attacks.dagger.config": ("DaggerConfig",),
        "attacks.dagger.report": ("write_report",),
        "attacks.dagger.result": ("Result",),
        "attacks.dagger.views": ("ViewDistribution",),
        "attacks.detectors": ("Detector", "load_detector", "wrap_detector"),
        "attacks.objectives.base": ("Objective",),
        "attacks.objectives.function": ("objective",),
        "attacks.objectives.relabel": ("relabel",),
        "attacks.objectives.suppression": ("hide", "untargeted"),
        "attacks.observe.comparison": ("evaluate",),
        "attacks.observe.rows": ("rows",),
        "attacks.search.budget": ("Budget",),
        "attacks.search.loop": ("pgd",),
        "attacks.studies.running": ("run_study",),
        "attacks.transformations.config": ("Transformations",),
    },
)
