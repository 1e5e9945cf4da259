"""Whether a plug-in keeps its contract: one function for each kind, to be called in a
test of the package that has it.

    from attacks.testing import check_detector

    def test_the_contract():
        check_detector(my_detector())

Each raises a `ContractError` that lists every promise that is broken, and what to do
about it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from mi_splat import _lazy

if TYPE_CHECKING:
    from attacks.testing.attacks import check_attack, check_poison
    from attacks.testing.detectors import check_detector, check_objective
    from attacks.testing.formats import check_format
    from attacks.testing.projections import check_projection
    from attacks.testing.promises import ContractError
    from attacks.testing.renderers import check_condition, check_renderer, check_rule
    from attacks.testing.strategies import check_strategy
    from attacks.testing.threats import check_threat

__all__ = [
    "ContractError",
    "check_attack",
    "check_condition",
    "check_detector",
    "check_format",
    "check_objective",
    "check_poison",
    "check_projection",
    "check_renderer",
    "check_rule",
    "check_strategy",
    "check_threat",
]

__getattr__, __dir__ = _lazy.attach(
    __name__,
    {
        "attacks.testing.attacks": ("check_attack", "check_poison"),
        "attacks.testing.detectors": ("check_detector", "check_objective"),
        "attacks.testing.formats": ("check_format",),
        "attacks.testing.projections": ("check_projection",),
        "attacks.testing.promises": ("ContractError",),
        "attacks.testing.renderers": (
            "check_condition",
            "check_renderer",
            "check_rule",
        ),
        "attacks.testing.strategies": ("check_strategy",),
        "attacks.testing.threats": ("check_threat",),
    },
)
