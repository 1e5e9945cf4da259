"""Everything adversarial: detectors, objectives, budgets, attacks, evaluation. Imports mi_splat, never the reverse.

The names below are imported when they are first used, so that importing this package is light, as `--help` needs it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from mi_splat import _lazy

if TYPE_CHECKING:
    from attacks.budgets import Budget
    from attacks.cloak import Poisoned, Poisoning, poison
    from attacks.config import DaggerConfig
    from attacks.dagger import attack
    from attacks.detectors import DETECTORS, Candidates, Detections, Detector, load_detector
    from attacks.objectives import Objective, Target, hide, relabel, untargeted
    from attacks.result import Result

__all__ = [
    "DETECTORS",
    "Budget",
    "Candidates",
    "DaggerConfig",
    "Detections",
    "Detector",
    "Objective",
    "Poisoned",
    "Poisoning",
    "Result",
    "Target",
    "attack",
    "hide",
    "load_detector",
    "poison",
    "relabel",
    "untargeted",
]

__getattr__, __dir__ = _lazy.attach(
    __name__,
    {
        "attacks.budgets": ("Budget",),
        "attacks.cloak": ("Poisoned", "Poisoning", "poison"),
        "attacks.config": ("DaggerConfig",),
        "attacks.dagger": ("attack",),
        "attacks.detectors": ("DETECTORS", "Candidates", "Detections", "Detector", "load_detector"),
        "attacks.objectives": ("Objective", "Target", "hide", "relabel", "untargeted"),
        "attacks.result": ("Result",),
    },
)
