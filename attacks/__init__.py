"""Everything adversarial: detectors, objectives, budgets, attacks, evaluation. Imports mi_splat, never the reverse.

The names below are imported when they are first used, so that importing this package is light, as `--help` needs it.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from attacks.budgets import Budget
    from attacks.dagger import DaggerConfig, Result, attack
    from attacks.detectors import DETECTORS, Candidates, Detections, Detector, load_detector
    from attacks.objectives import Objective, Target, hide, relabel, untargeted

_HOMES = {
    "attacks.budgets": ("Budget",),
    "attacks.dagger": ("DaggerConfig", "Result", "attack"),
    "attacks.detectors": ("DETECTORS", "Candidates", "Detections", "Detector", "load_detector"),
    "attacks.objectives": ("Objective", "Target", "hide", "relabel", "untargeted"),
}
_HOME_OF = {name: home for home, names in _HOMES.items() for name in names}

__all__ = [
    "DETECTORS",
    "Budget",
    "Candidates",
    "DaggerConfig",
    "Detections",
    "Detector",
    "Objective",
    "Result",
    "Target",
    "attack",
    "hide",
    "load_detector",
    "relabel",
    "untargeted",
]


def __getattr__(name: str) -> object:
    if name not in _HOME_OF:
        raise AttributeError(f"module 'attacks' has no attribute {name!r}")
    value = getattr(importlib.import_module(_HOME_OF[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
