"""Kinds of poison by their names: those of this project, and those of other packages;
light, for flags.

CLOAK, whose settings are not light, joins them with `attacks.poisons.poisoned`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from attacks.poisons.config import (
    MIFGSMConfig,
    PoisonSplatConfig,
    RaisedVariationConfig,
    UniformNoiseConfig,
)
from mi_splat.errors import InvalidValueError
from mi_splat.fields import check_choice, decode
from mi_splat.registry import Registry

if TYPE_CHECKING:
    from attacks.classifiers.base import Classifier
    from attacks.cloak.setup import Setup
    from attacks.poisons.base import ImagePoison, Masks
    from attacks.poisons.poison_splat import Decoy

Need = Literal["splat", "classifier", "object", "scene"]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Given:
    """What an attacker has besides the images."""

    decoy: Decoy | None = None  # it starts as the splat of the set
    masks: Masks | None = None  # where the object is
    classifier: Classifier | None = None  # that is to be deceived
    label: str = ""  # the object's true class
    setup: Setup | None = None  # the scene of a study
    # images of them, by the name of a job's input
    appearances: Mapping[str, Path] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, kw_only=True)
class PoisonSpec:
    """A kind of poison that is known by its name.

    Attributes:
        name: What studies and `mi-splat poison --kind` call it.
        config: A frozen dataclass, keyword-only, whose fields all have defaults; they
            are the settings, and the flags.
        make: The poison of settings, from what the attacker has.
        needs: What it cannot do without: "splat", so that it is given a decoy,
            "object", masks of it, "classifier", with the object's class, or a study's
            "scene". Whoever makes the poison, a command or a study, provides it.
    """

    name: str
    config: type[Any]
    make: Callable[[Any, Given], ImagePoison]
    needs: tuple[Need, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class ChosenPoison:
    """A kind of poison and its settings, as studies and jobs keep them."""

    kind: str
    settings: Mapping[str, Any]
    package: str = ""

    @classmethod
    def of(cls, table: object, where: str) -> ChosenPoison:
        """The poison of a study's table."""
        if not isinstance(table, Mapping):
            raise InvalidValueError.of(
                where, "a table", repr(table), 'write { kind = "poison-splat" }'
            )
        check_choice(f"kind of {where}", table.get("kind"), tuple(POISONS))
        kind = str(table["kind"])
        config = decode(
            POISONS[kind].config,
            {key: table[key] for key in table if key != "kind"},
            where,
        )
        return cls(kind=kind, settings=asdict(config), package=POISONS.package(kind))

    @property
    def spec(self) -> PoisonSpec:
        """Its kind."""
        return POISONS.chosen(self.kind)

    @property
    def config(self) -> Any:
        """Its settings as the kind has them."""
        return decode(self.spec.config, self.settings, self.kind)


def _poison_splat(config: PoisonSplatConfig, given: Given) -> ImagePoison:
    from attacks.poisons.poison_splat import PoisonSplat

    assert given.decoy is not None
    return PoisonSplat(config=config, begun=given.decoy)


def _control(
    config: UniformNoiseConfig | RaisedVariationConfig, given: Given
) -> ImagePoison:
    from attacks.poisons.poison_splat import RaisedVariation, UniformNoise

    if isinstance(config, UniformNoiseConfig):
        return UniformNoise(config=config)
    return RaisedVariation(config=config)


def _m_ifgsm(config: MIFGSMConfig, given: Given) -> ImagePoison:
    from attacks.poisons.mifgsm import MIFGSM

    assert given.classifier is not None
    return MIFGSM(
        config=config,
        classifier=given.classifier,
        label=given.label,
        masks=given.masks,
        decoy=given.decoy,
    )


POISONS: Registry[PoisonSpec] = Registry(
    "mi_splat.poisons",
    "a PoisonSpec",
    lambda value: isinstance(value, PoisonSpec),
    what="poison",
)
"""Name to spec of each kind of poison: those of this project, and those of other
packages.
"""

for _spec in (
    PoisonSpec(
        name="poison-splat",
        config=PoisonSplatConfig,
        make=_poison_splat,
        needs=("splat",),
    ),
    PoisonSpec(name="uniform-noise", config=UniformNoiseConfig, make=_control),
    PoisonSpec(name="raised-variation", config=RaisedVariationConfig, make=_control),
    PoisonSpec(
        name="m-ifgsm",
        config=MIFGSMConfig,
        make=_m_ifgsm,
        needs=("classifier", "object"),
    ),
):
    POISONS.add(_spec.name, _spec)
