"""Everything adversarial: detectors, objectives, budgets, attacks, evaluation. Imports mi_splat, never the reverse.

The names below are imported when they are first used, so that importing this package is light, as `--help` needs it.
Who adds a detector of their own finds the interface in `attacks.detectors`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from mi_splat import _lazy

if TYPE_CHECKING:
    from attacks.cloak.poisoning import Poisoning, poison
    from attacks.cloak.triggers import Azimuth, Elevation
    from attacks.dagger.attack import attack, attack_views
    from attacks.dagger.config import DaggerConfig, EotConfig
    from attacks.dagger.report import write_report
    from attacks.dagger.views import ViewDistribution
    from attacks.detectors import load_detector
    from attacks.objectives import hide, relabel, untargeted
    from attacks.observe.comparison import compare, compared_rows
    from attacks.observe.rates import count
    from attacks.observe.rows import rows
    from attacks.observe.views import detect_views, evaluate

__all__ = [
    "Azimuth",
    "DaggerConfig",
    "Elevation",
    "EotConfig",
    "Poisoning",
    "ViewDistribution",
    "attack",
    "attack_views",
    "compare",
    "compared_rows",
    "count",
    "detect_views",
    "evaluate",
    "hide",
    "load_detector",
    "poison",
    "relabel",
    "rows",
    "untargeted",
    "write_report",
]

__getattr__, __dir__ = _lazy.attach(
    __name__,
    {
        "attacks.cloak.poisoning": ("Poisoning", "poison"),
        "attacks.cloak.triggers": ("Azimuth", "Elevation"),
        "attacks.dagger.attack": ("attack", "attack_views"),
        "attacks.dagger.config": ("DaggerConfig", "EotConfig"),
        "attacks.dagger.report": ("write_report",),
        "attacks.dagger.views": ("ViewDistribution",),
        "attacks.detectors": ("load_detector",),
        "attacks.observe.comparison": ("compare", "compared_rows"),
        "attacks.observe.rates": ("count",),
        "attacks.observe.rows": ("rows",),
        "attacks.observe.views": ("detect_views", "evaluate"),
        "attacks.objectives": ("hide", "relabel", "untargeted"),
    },
)
