"""Optimisers by their names, and the limits of a perturbation; light, so that options
can be parsed without torch.

The loop, the ball, the judge and the trace are the same for all. One of your own
becomes one of them by `register_optimiser`, or by an entry point (docs/plug-ins.md):

    def make(settings: SearchSettings) -> Optimiser: ...

    spec = OptimiserSpec(name="mine", make=make, about="what it does, in a line")
    register_optimiser(spec)
    attack(..., config=DaggerConfig(optimiser="mine"))
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, Literal, get_args

from mi_splat.fields import Metavar, at_least, check_choice
from mi_splat.registry import Registry

if TYPE_CHECKING:
    from attacks.optimisers.methods import SearchSettings
    from attacks.search.loop import Optimiser

NormName = Literal["linf", "l2", "l2_per_gaussian"]
"""`linf`: largest change of a coefficient; `l2`: one ball over the object;
`l2_per_gaussian`: a ball for each row.
"""

NORM_NAMES: tuple[NormName, ...] = get_args(NormName)

Schedule = Literal["constant", "linear", "cosine"]
"""How the steps of a search become shorter: not at all, along a line to 0, or along
half a cosine to 0.
"""

Radius = Annotated[
    float, at_least(0, "units of the splat file", "5 is the paper's"), Metavar("RADIUS")
]
"""Largest size of a perturbation; 0 changes nothing."""


@dataclass(frozen=True, slots=True, kw_only=True)
class OptimiserSpec:
    """An optimiser that can be chosen by its name.

    Attributes:
        name: What it is called, in configurations, studies and `--optimiser`.
        make: Makes it for one search. Import what is heavy in it, not beside it.
        about: What it does, in a line.
        gradient: Whether it looks at gradients; without, none are computed.
        momentum: Share of the earlier gradients that it keeps where a configuration
            says nothing.
        smallest: Whether of two successes the smaller change is kept; otherwise it is
            the one with the higher score.
    """

    name: str
    make: Callable[[SearchSettings], Optimiser]
    about: str
    gradient: bool = True
    momentum: float = 0.0
    smallest: bool = False


OPTIMISERS: Registry[OptimiserSpec] = Registry(
    "mi_splat.attacks",
    "an OptimiserSpec",
    lambda value: isinstance(value, OptimiserSpec),
    what="optimiser",
)
"""Every optimiser by its name: those of this project, those that were registered, and
those of other packages.
"""


def register_optimiser(spec: OptimiserSpec) -> None:
    """Make an optimiser known to every configuration of this process."""
    OPTIMISERS.add(spec.name, spec)


def optimiser_spec(name: str) -> OptimiserSpec:
    """The optimiser of a name."""
    if name not in OPTIMISERS.own:
        check_choice("optimiser", name, tuple(OPTIMISERS))
    return OPTIMISERS[name]


def _ship(name: str, about: str, function: str = "", **more: Any) -> None:
    """Register an optimiser of this package, a function that has its name or another
    one.

    Its module is imported when the first one is made; the whole name of it stands here
    for the keys of jobs.
    """

    def make(settings: SearchSettings) -> Optimiser:
        made: Optimiser = getattr(
            importlib.import_module("attacks.optimisers.methods"), function or name
        )(settings)
        return made

    register_optimiser(OptimiserSpec(name=name, make=make, about=about, **more))


_ship("pgd", "steps of fixed length along the steepest slope", "momentum")
_ship("fgsm", "one step, as long as the radius")
_ship("momentum", "the same steps along a decaying sum of slopes", momentum=0.9)
_ship("adam", "steps of Adam", momentum=0.9)
_about = "long steps that halve where the loss no longer falls, from the best point"
_ship("apgd", _about, momentum=0.25)
_about = (
    "steps of Adam on the loss and a price of the change, with a search over the price"
)
_ship("cw", _about, momentum=0.9, smallest=True)
_about = "blocks of neighbouring Gaussians at random, kept where the loss falls"
_ship("square", _about, gradient=False)
_ship(
    "random",
    "points at random, half of them near the best one",
    "random_points",
    gradient=False,
)
