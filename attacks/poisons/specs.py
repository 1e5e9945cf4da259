"""Poisons by their names: those of this project, and those of other packages; light, for flags.

CLOAK, whose settings are not light, joins them with `attacks.poisons.registry`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from attacks.poisons.config import MIFGSMConfig, PoisonSplatConfig, RaisedVariationConfig, UniformNoiseConfig
from mi_splat.errors import InvalidValueError, message
from mi_splat.registry import Registry

if TYPE_CHECKING:
    from attacks.poisons.base import PicturePoison
    from attacks.poisons.decoy import Decoy


@dataclass(frozen=True, slots=True, kw_only=True)
class PoisonSpec:
    """A kind of poison that is known by its name.

    Attributes:
        name: What studies and `mi-splat poison --kind` call it.
        config: A frozen dataclass, keyword-only, whose fields all have defaults; they are the settings, and the flags.
        make: The poison of settings. It gets a decoy that starts as the splat of the set, or None where there is none.
            None where a poison needs more than that, which its callers know.
        needs_splat: Whether there is no poison without a decoy.
    """

    name: str
    config: type[Any]
    make: Callable[[Any, Decoy | None], PicturePoison] | None = None
    needs_splat: bool = False

    def poison(self, config: Any, decoy: Decoy | None) -> PicturePoison:
        """The poison of settings."""
        if self.make is None or (self.needs_splat and decoy is None):
            expected, do = "one that needs no more than a splat", "run it as a study"
            raise InvalidValueError(message("poison", expected, type(config).__name__, do))
        return self.make(config, decoy)


def _poison_splat(config: PoisonSplatConfig, decoy: Decoy | None) -> PicturePoison:
    from attacks.poisons.poison_splat import PoisonSplat

    assert decoy is not None  # as `poison_of` has seen to
    return PoisonSplat(config=config, begun=decoy)


def _uniform_noise(config: UniformNoiseConfig, decoy: Decoy | None) -> PicturePoison:
    from attacks.poisons.poison_splat import UniformNoise

    return UniformNoise(config=config)


def _raised_variation(config: RaisedVariationConfig, decoy: Decoy | None) -> PicturePoison:
    from attacks.poisons.poison_splat import RaisedVariation

    return RaisedVariation(config=config)


POISONS: Registry[PoisonSpec] = Registry(
    "mi_splat.poisons", "a PoisonSpec", lambda value: isinstance(value, PoisonSpec), what="poison"
)
"""Name to spec of each kind of poison: those of this project, and those of other packages."""

for _spec in (
    PoisonSpec(name="poison-splat", config=PoisonSplatConfig, make=_poison_splat, needs_splat=True),
    PoisonSpec(name="uniform-noise", config=UniformNoiseConfig, make=_uniform_noise),
    PoisonSpec(name="raised-variation", config=RaisedVariationConfig, make=_raised_variation),
    PoisonSpec(name="m-ifgsm", config=MIFGSMConfig),
):
    POISONS.add(_spec.name, _spec)
