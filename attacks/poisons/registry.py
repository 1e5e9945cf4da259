"""Poisons by their names, for studies and commands: settings from a table, and the poison of settings."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from attacks.cloak.config import AttackConfig
from attacks.poisons.config import MIFGSMConfig, PoisonSplatConfig, RaisedVariationConfig, UniformNoiseConfig
from attacks.poisons.specs import POISONS, PoisonSpec
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


@dataclass(frozen=True, slots=True, kw_only=True)
class PluggedPoison:
    """The settings of another package's poison, as a study keeps them.

    Attributes:
        kind: Name of the poison.
        settings: Its settings, as in the study's file.
        package: Which package brings it, with its version: another version is another poison.
    """

    kind: str
    settings: Mapping[str, Any]
    package: str


PoisonConfig = (
    PoisonSplatConfig | UniformNoiseConfig | RaisedVariationConfig | MIFGSMConfig | CloakConfig | PluggedPoison
)


POISONS.add("cloak", PoisonSpec(name="cloak", config=CloakConfig))


def poison_config(table: Mapping[str, Any], where: str) -> PoisonConfig:
    """The settings of a poison."""
    if not isinstance(table, Mapping):
        raise InvalidValueError(message(where, "a table", repr(table), 'write { kind = "poison-splat" }'))
    check_choice(f"kind of {where}", table.get("kind"), tuple(POISONS))
    settings = {key: value for key, value in table.items() if key != "kind"}
    kind = table["kind"]
    config: PoisonConfig = decode(POISONS[kind].config, settings, where)
    package = POISONS.package(kind)
    return PluggedPoison(kind=kind, settings=settings, package=package) if package else config


def poison_of(config: PoisonConfig, decoy: Decoy | None) -> PicturePoison:
    """The poison of settings; those of M-IFGSM and CLOAK need more than a decoy."""
    if isinstance(config, PluggedPoison):
        spec = POISONS.chosen(config.kind)
        config = decode(spec.config, config.settings, config.kind)
    else:
        spec = next(spec for spec in POISONS.own.values() if isinstance(config, spec.config))
    return spec.poison(config, decoy)
