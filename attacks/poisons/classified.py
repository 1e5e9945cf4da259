"""A kind of job: what a classifier takes the object for, on a splat or in pictures that are there."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from attacks.classifiers.base import Classifier
from attacks.classifiers.frozen import classified
from attacks.classifiers.registry import load_classifier
from attacks.cloak.kinds.pictures import read_pictures
from attacks.cloak.setup import SET, Pose, SplatJob
from mi_splat.datasets import load_dataset
from mi_splat.errors import InvalidValueError
from mi_splat.io import load_splat
from mi_splat.io.images import through_png

if TYPE_CHECKING:
    from mi_splat.ledger import Out

LOADS = (
    "attacks.classifiers.prototypes",
    "attacks.classifiers.torchvision",
    "attacks.classifiers.clip",
)


@dataclass(frozen=True, slots=True, kw_only=True)
class ClassifiedConfig(SplatJob):
    """Which classifier judges, and from which cameras."""

    classifier: str
    fingerprint: str
    label: str
    poses: tuple[Pose, ...] = ()


def run(config: ClassifiedConfig, inputs: Mapping[str, Path], out: Out) -> list[dict[str, Any]]:
    """A row for each picture of a `splat`, of a `set`, or of `pictures`."""
    classifier = checked_classifier(config.classifier, config.fingerprint, config.device)
    pictures = list(_pictures(config, inputs))
    rows = []
    for view, row in enumerate(classified(classifier, pictures, config.label)):
        cells = {"view": view, "detector": config.classifier, "original": config.label, "label": row["top1"]}
        rows.append({**cells, "original_score": row["confidence"], "success": not row["right"]})
        out.progress(f"{config.classifier} looks", view + 1, len(pictures))
    return rows


def _pictures(config: ClassifiedConfig, inputs: Mapping[str, Path]) -> Iterator[Tensor]:
    """The pictures as files of 8 bits have them."""
    if "set" in inputs:
        views = load_dataset(inputs["set"] / SET, split="train", background=config.background)
        yield from (view.image for view in views)
    elif "pictures" in inputs:
        yield from read_pictures(inputs["pictures"]).images
    else:
        render = config.renderer()
        scene = load_splat(inputs["splat"]).to(config.device)
        for pose in config.poses:
            with torch.no_grad():
                yield through_png(render(scene, pose.camera))


def checked_classifier(name: str, fingerprint: str, device: str) -> Classifier:
    """The classifier of a job, on a device."""
    classifier = load_classifier(name)
    if classifier.fingerprint != fingerprint:
        do = "get the weights that the study began with, or begin it anew"
        raise InvalidValueError.of(f"weights of {name}", fingerprint, classifier.fingerprint, do)
    move(classifier, device)
    return classifier


def move(classifier: Classifier, device: str) -> None:
    """Put a classifier's network, if it has one, on a device."""
    model = getattr(classifier, "model", None)
    if isinstance(model, torch.nn.Module):
        model.to(device)
