"""CLOAK of a study's own scene as a kind of poison."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from attacks.cloak.appearances import Appearance, name_of
from attacks.cloak.config import AttackConfig
from attacks.cloak.kinds.pictures import APPEARANCE, KeptAppearance
from attacks.cloak.poisoning import Cloak, Poisoning
from attacks.poisons.specs import POISONS, Given, PoisonSpec

CLOAK = "cloak"
"""Name of the kind."""


@dataclass(frozen=True, slots=True, kw_only=True)
class CloakConfig:
    """CLOAK of a study's own scene."""

    attack: tuple[AttackConfig, ...]


def _cloak(config: CloakConfig, given: Given) -> Cloak:
    """CLOAK of appearances whose pictures are files."""
    assert given.setup is not None
    setup = replace(given.setup, attacks=config.attack)

    def kept(appearance: Appearance, attack: AttackConfig) -> Appearance:
        return KeptAppearance(name=name_of(appearance), folder=given.appearances[f"{APPEARANCE}{attack.name}"])

    def poisonings(seed: int) -> Sequence[Poisoning]:
        return setup.poisonings(seed=seed, cached=kept, surrogates=given.surrogates, gain=given.gain)

    return Cloak(poisonings=poisonings, centre=setup.centre, masks=setup.mesh_scene.mask)


POISONS.add(CLOAK, PoisonSpec(name=CLOAK, config=CloakConfig, make=_cloak, needs=("scene",)))
