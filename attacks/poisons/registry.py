"""Poisons by their names, for studies and commands: settings from a table, and the poison of settings."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from attacks.cloak.config import AttackConfig
from attacks.poisons.config import MIFGSMConfig, PoisonSplatConfig, RaisedVariationConfig, UniformNoiseConfig
from mi_splat.errors import InvalidValueError, message
from mi_splat.fields import check_choice, decode

if TYPE_CHECKING:
    from attacks.poisons.base import PicturePoison
    from attacks.poisons.decoy import Decoy


@dataclass(frozen=True, slots=True, kw_only=True)
class CloakConfig:
    """CLOAK of a study's own scene.

    Attributes:
        attack: The hidden appearances; no camera may belong to two.
    """

    attack: tuple[AttackConfig, ...]


PoisonConfig = PoisonSplatConfig | UniformNoiseConfig | RaisedVariationConfig | MIFGSMConfig | CloakConfig

POISONS: dict[str, type[PoisonConfig]] = {
    "poison-splat": PoisonSplatConfig,
    "uniform-noise": UniformNoiseConfig,
    "raised-variation": RaisedVariationConfig,
    "m-ifgsm": MIFGSMConfig,
    "cloak": CloakConfig,
}
"""Settings of each kind of poison."""


def poison_config(table: Mapping[str, Any], where: str) -> PoisonConfig:
    """The settings of a poison.

    Args:
        table: With its `kind`.
        where: Name of the table, for errors.

    Raises:
        InvalidValueError: There is no such kind, or a setting is unknown or cannot be.
    """
    if not isinstance(table, Mapping):
        raise InvalidValueError(message(where, "a table", repr(table), 'write { kind = "poison-splat" }'))
    check_choice(f"kind of {where}", table.get("kind"), tuple(POISONS))
    return decode(POISONS[table["kind"]], {key: value for key, value in table.items() if key != "kind"}, where)


def poison_of(config: PoisonConfig, decoy: Decoy | None) -> PicturePoison:
    """The poison of settings; those of M-IFGSM and CLOAK need more than a decoy.

    Args:
        config: The settings.
        decoy: Where one begins; only Poison-splat needs one.

    Raises:
        InvalidValueError: Settings are CLOAK's or M-IFGSM's, or those of Poison-splat without a decoy.
    """
    from attacks.poisons.poison_splat import PoisonSplat, RaisedVariation, UniformNoise

    match config:
        case UniformNoiseConfig():
            return UniformNoise(config=config)
        case RaisedVariationConfig():
            return RaisedVariation(config=config)
        case PoisonSplatConfig() if decoy is not None:
            return PoisonSplat(config=config, begun=decoy)
    expected, do = "one that needs no more than a splat", "run it as a study"
    raise InvalidValueError(message("poison", expected, type(config).__name__, do))
