"""A kind of job: the set that a poison makes of another, with its manifest and a sheet of some changed pictures."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from attacks.cloak.config import fit_config
from attacks.cloak.kinds.parts import SET, StepConfig
from attacks.poisons.base import MANIFEST, PicturePoison
from attacks.poisons.classified import checked_classifier
from attacks.poisons.config import MIFGSMConfig
from attacks.poisons.decoy import Decoy
from attacks.poisons.masks import read_masks
from attacks.poisons.mifgsm import MIFGSM
from attacks.poisons.registry import PoisonConfig, poison_of
from attacks.poisons.writing import difference_sheet, write_poisoned
from mi_splat.datasets import load_dataset
from mi_splat.io import load_splat
from mi_splat.io.documents import save_json, save_png

if TYPE_CHECKING:
    from mi_splat.ledger import Out

SHEET = "poisoned.png"


@dataclass(frozen=True, slots=True, kw_only=True)
class ChangedConfig(StepConfig):
    """Which poison.

    Attributes:
        poison: Its kind and settings.
        device: Where it is made, "cpu" or "cuda".
        classifier: Who is deceived, if the poison deceives anybody.
        fingerprint: Of its weights and classes.
        label: The true class of the object.
    """

    poison: PoisonConfig
    device: str = "cpu"
    classifier: str = ""
    fingerprint: str = ""
    label: str = ""


def run(config: ChangedConfig, inputs: Mapping[str, Path], out: Out) -> None:
    """Poison the `pictures`; a decoy starts as the `splat`, and M-IFGSM knows the `masks`."""
    study, background = config.asked, config.asked.scene.background
    views = load_dataset(inputs["pictures"] / SET, split="train", background=background)
    decoy = None
    if "splat" in inputs:
        near = study.training.near
        assert near is not None
        start, victim = load_splat(inputs["splat"]).to(config.device), fit_config(study.training)
        decoy = Decoy(start=start, near=near, background=background, victim=victim)
    if isinstance(config.poison, MIFGSMConfig):
        classifier = checked_classifier(config.classifier, config.fingerprint, config.device)
        masks, label = read_masks(inputs["masks"]), config.label
        poison: PicturePoison = MIFGSM(
            config=config.poison, classifier=classifier, label=label, masks=masks, decoy=decoy
        )
    else:
        poison = poison_of(config.poison, decoy)
    done = poison(views, seed=study.seeds[0], on_step=partial(out.progress, "poisoning"))
    write_poisoned(out / SET, views, done)
    save_json(done.manifest, out / MANIFEST)
    save_png(difference_sheet(done), out / SHEET)
