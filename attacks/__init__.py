"""Everything adversarial: detectors, objectives, budgets, attacks, evaluation. Imports mi_splat, never the reverse.

The names below are imported when they are first used, so that importing this package is light, as `--help` needs it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from mi_splat import _lazy

if TYPE_CHECKING:
    from attacks.budgets import Budget
    from attacks.cloak.poisoning import Poisoned, Poisoning, poison
    from attacks.dagger.attack import attack
    from attacks.dagger.config import DaggerConfig
    from attacks.dagger.result import Result
    from attacks.detectors import (
        DETECTORS,
        Candidates,
        Detections,
        Detector,
        DetectorSpec,
        load_detector,
        register_detector,
    )
    from attacks.objectives import Objective, Target, hide, relabel, untargeted

__all__ = [
    "DETECTORS",
    "Budget",
    "Candidates",
    "DaggerConfig",
    "Detections",
    "Detector",
    "DetectorSpec",
    "Objective",
    "Poisoned",
    "Poisoning",
    "Result",
    "Target",
    "attack",
    "hide",
    "load_detector",
    "poison",
    "register_detector",
    "relabel",
    "untargeted",
]

__getattr__, __dir__ = _lazy.attach(
    __name__,
    {
        "attacks.budgets": ("Budget",),
        "attacks.cloak.poisoning": ("Poisoned", "Poisoning", "poison"),
        "attacks.dagger.config": ("DaggerConfig",),
        "attacks.dagger.attack": ("attack",),
        "attacks.detectors": (
            "DETECTORS",
            "Candidates",
            "Detections",
            "Detector",
            "DetectorSpec",
            "load_detector",
            "register_detector",
        ),
        "attacks.objectives": ("Objective", "Target", "hide", "relabel", "untargeted"),
        "attacks.dagger.result": ("Result",),
    },
)
