"""A kind of job: the set that a poison, or a victim's filter, makes of another, with a
manifest and a sheet.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from attacks.cloak.appearances import Appearance, name_of
from attacks.cloak.config import AttackConfig, TrainingConfig, fit_config
from attacks.cloak.kinds.pictures import APPEARANCE, KeptAppearance
from attacks.cloak.poisoning import poison
from attacks.cloak.setup import SET, Setup
from attacks.poisons.base import MANIFEST, ImagePoison, OnStep, Poisoned, poisoned
from attacks.poisons.config import FilterConfig
from attacks.poisons.defences import filtered
from attacks.poisons.judged import checked_classifier
from attacks.poisons.poison_splat import Decoy
from attacks.poisons.specs import POISONS, ChosenPoison, Given, PoisonSpec
from attacks.poisons.writing import difference_sheet, write_poisoned
from mi_splat.cameras.camera import View
from mi_splat.capture.path_tracer import tracing_variant
from mi_splat.datasets import load_dataset
from mi_splat.io import load_splat
from mi_splat.io.documents import save_json, save_png

if TYPE_CHECKING:
    from mi_splat.ledger import Out

CLOAK = "cloak"
"""Name of the kind."""


@dataclass(frozen=True, slots=True, kw_only=True)
class CloakConfig:
    """CLOAK of a study's own scene."""

    attack: tuple[AttackConfig, ...]


def _cloak(config: CloakConfig, given: Given) -> ImagePoison:
    assert given.setup is not None
    setup = replace(given.setup, attacks=config.attack).given(given.appearances)

    def kept(appearance: Appearance, attack: AttackConfig) -> Appearance:
        return KeptAppearance(
            name=name_of(appearance),
            folder=given.appearances[f"{APPEARANCE}{attack.name}"],
        )

    def cloaked(
        views: Sequence[View], *, seed: int = 0, on_step: OnStep | None = None
    ) -> Poisoned:
        attacks = setup.poisonings(seed=seed, cached=kept)
        return poison(
            views,
            attacks,
            centre=setup.centre,
            masks=setup.mesh_scene.mask,
            on_step=on_step,
        )

    return cloaked


POISONS.add(
    CLOAK, PoisonSpec(name=CLOAK, config=CloakConfig, make=_cloak, needs=("scene",))
)


SHEET = "poisoned.png"


@dataclass(frozen=True, slots=True, kw_only=True)
class PoisonedConfig:
    """Which poison."""

    poison: ChosenPoison | FilterConfig
    background: tuple[float, float, float]  # sRGB behind the images
    seed: int = 0
    scene: Setup | None = None
    near: float | None = None
    training: TrainingConfig | None = None
    device: str = "cpu"
    classifier: str = ""
    fingerprint: str = ""
    label: str = ""


def run(config: PoisonedConfig, inputs: Mapping[str, Path], out: Out) -> None:
    """Poison the `pictures`; a decoy starts as the `splat`."""
    views = load_dataset(
        inputs["pictures"] / SET, split="train", background=config.background
    )
    if isinstance(config.poison, FilterConfig):
        pictures = {
            index: filtered(view.image, config.poison)
            for index, view in enumerate(views)
        }
        write_poisoned(out / SET, views, poisoned(views, pictures, {}))
        return
    chosen = config.poison
    given = _given(config, chosen.spec, inputs)
    attack = chosen.spec.make(chosen.config, given)
    with tracing_variant() if chosen.kind == CLOAK else nullcontext():
        done = attack(
            views, seed=config.seed, on_step=partial(out.progress, "poisoning")
        )
    write_poisoned(out / SET, views, done)
    save_json(done.manifest, out / MANIFEST)
    if chosen.kind != CLOAK:
        save_png(difference_sheet(done), out / SHEET)


def _given(
    config: PoisonedConfig, spec: PoisonSpec, inputs: Mapping[str, Path]
) -> Given:
    setup = config.scene and config.scene.given(inputs)
    decoy = classifier = masks = None
    if "splat" in inputs:
        assert config.near is not None
        assert config.training is not None
        start = load_splat(inputs["splat"]).to(config.device)
        victim = fit_config(config.training)
        decoy = Decoy(
            start=start, near=config.near, background=config.background, victim=victim
        )
    if config.classifier:
        classifier = checked_classifier(
            config.classifier, config.fingerprint, config.device
        )
    if "object" in spec.needs:
        assert setup is not None
        with tracing_variant():
            masks = [setup.mesh_scene.mask(camera) for camera in setup.training_cameras]
    return Given(
        decoy=decoy,
        masks=masks,
        classifier=classifier,
        label=config.label,
        setup=setup,
        appearances=inputs,
    )
