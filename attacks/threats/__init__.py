"""What an attack may change of an object, by names: attributes of its Gaussians, or
parameters of its own that change these, such as a rigid motion; light, for flags.

One of your own becomes one of them by `THREATS.add`, or by an entry point
(docs/plug-ins.md).
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from mi_splat.attributes import ATTRIBUTES, Attribute
from mi_splat.registry import Registry

if TYPE_CHECKING:
    from torch import Tensor

    from attacks.search.parameters import Parameters


@dataclass(frozen=True, slots=True, kw_only=True)
class Threat:
    """Parameters of an attack that are no attribute of the Gaussians.

    The object's tensors are those of a splat file: means (N, 3) in world units, scales
    (N, 3) as logarithms, rotations (N, 4) as quaternions of any length, opacities (N,)
    as logits, sh (N, K, 3).

    Attributes:
        name: What `--attributes` and studies call it.
        about: What it does, in a line.
        unit: Unit of its values, in which its radius is.
        changes: The attributes that it changes.
        start: From the clean object's tensors, the value that changes nothing, of any
            shape and of their dtype and device.
        apply: From a value and the object's tensors, the tensors that it changes;
            differentiable in both.
    """

    name: str
    about: str
    unit: str
    changes: tuple[Attribute, ...]
    start: Callable[[Parameters], Tensor]
    apply: Callable[[Tensor, Parameters], Parameters]


THREATS: Registry[Threat] = Registry(
    "mi_splat.threats",
    "a Threat",
    lambda value: isinstance(value, Threat),
    what="attribute",
)
"""Every threat by its name."""


def names() -> tuple[str, ...]:
    """All that an attack may change: attributes of Gaussians, and threats."""
    return (*ATTRIBUTES, *THREATS)


def _ship(module: str, name: str, changes: tuple[Attribute, ...], **words: str) -> None:
    """Register a threat of this package, whose module is imported when it is used."""

    def start(clean: Parameters) -> Tensor:
        value: Tensor = _function(module, f"{name}_start")(clean)
        return value

    def apply(value: Tensor, tensors: Parameters) -> Parameters:
        changed: Parameters = _function(module, f"apply_{name}")(value, tensors)
        return changed

    THREATS.add(
        name,
        Threat(name=name, changes=changes, start=start, apply=apply, **words),
    )


def _function(module: str, name: str) -> Callable[..., Any]:
    function: Callable[..., Any] = getattr(
        importlib.import_module(f"attacks.threats.{module}"), name
    )
    return function


_ship(
    "rigid",
    "shift",
    ("means",),
    about="the object is moved as a whole",
    unit="world units",
)
_ship(
    "rigid",
    "turn",
    ("means", "rotations", "sh"),
    about="the object is turned about its centre; colours turn with it",
    unit="radians",
)
_ship(
    "lattice",
    "lattice",
    ("means",),
    about="the object is bent by a lattice of 4 x 4 x 4 points around it",
    unit="world units",
)
