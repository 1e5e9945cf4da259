"""A kind of job: what a classifier takes the object for, or how true a victim's splat
is and how fast it is drawn.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from attacks.classifiers.base import Classifier
from attacks.classifiers.frozen import classified
from attacks.classifiers.registry import load_classifier
from attacks.cloak.kinds.pictures import read_pictures
from attacks.cloak.setup import SET, Pose, SplatJob
from mi_splat.cameras.camera import Camera, project_points
from mi_splat.datasets import load_dataset
from mi_splat.errors import InvalidValueError
from mi_splat.io import load_splat
from mi_splat.io.documents import save_json, save_png
from mi_splat.io.images import through_png, to_bytes
from mi_splat.maths.metrics import psnr, ssim
from mi_splat.maths.sh import dc_to_colour
from mi_splat.scene import GaussianScene

if TYPE_CHECKING:
    from mi_splat.ledger import Out

LOADS = ("attacks.classifiers.prototypes", "attacks.classifiers.torchvision")


@dataclass(frozen=True, slots=True, kw_only=True)
class ClassifiedConfig(SplatJob):
    """Which classifier judges, and from which cameras."""

    classifier: str
    fingerprint: str
    label: str
    poses: tuple[Pose, ...] = ()


def run(
    config: ClassifiedConfig | MeasuredConfig, inputs: Mapping[str, Path], out: Out
) -> list[dict[str, Any]]:
    """Classify, or measure."""
    if isinstance(config, ClassifiedConfig):
        return _classified(config, inputs, out)
    return _measured(config, inputs, out)


def _classified(
    config: ClassifiedConfig, inputs: Mapping[str, Path], out: Out
) -> list[dict[str, Any]]:
    """A row for each image of a `splat`, of a `set`, or of `pictures`."""
    classifier = checked_classifier(
        config.classifier, config.fingerprint, config.device
    )
    pictures = list(_pictures(config, inputs))
    rows = []
    for view, row in enumerate(classified(classifier, pictures, config.label)):
        cells = {
            "view": view,
            "detector": config.classifier,
            "original": config.label,
            "label": row["top1"],
        }
        rows.append(
            {**cells, "original_score": row["confidence"], "success": not row["right"]}
        )
        out.progress(f"{config.classifier} looks", view + 1, len(pictures))
    return rows


def _pictures(config: ClassifiedConfig, inputs: Mapping[str, Path]) -> Iterator[Tensor]:
    """The images as files of 8 bits have them."""
    if "set" in inputs:
        views = load_dataset(
            inputs["set"] / SET, split="train", background=config.background
        )
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
        raise InvalidValueError.of(
            f"weights of {name}", fingerprint, classifier.fingerprint, do
        )
    move(classifier, device)
    return classifier


def move(classifier: Classifier, device: str) -> None:
    """Put a classifier's network, if it has one, on a device."""
    model = getattr(classifier, "model", None)
    if isinstance(model, torch.nn.Module):
        model.to(device)


# Against true images from cameras of no training

COUNT = "count.json"
SPEED = "speed.json"
CENTRES = "centres.png"
VARIES = (SPEED,)
_WARM = 2
_SIZE = 384


@dataclass(frozen=True, slots=True, kw_only=True)
class MeasuredConfig(SplatJob):
    """From where: the cameras of the true images."""

    poses: tuple[Pose, ...]


def _measured(
    config: MeasuredConfig, inputs: Mapping[str, Path], out: Out
) -> list[dict[str, Any]]:
    """A row for each camera of how true the `splat` is to the `pictures`; how long one
    takes; where its Gaussians are.

    The time is CPU time of the process, and on a GPU the wall time of an image that
    was waited for.
    """
    cuda = config.device == "cuda"
    scene = load_splat(inputs["splat"]).to(config.device)
    render = config.renderer()
    cameras = [pose.camera for pose in config.poses]
    true = read_pictures(inputs["pictures"]).images
    clock = time.perf_counter if cuda else time.process_time
    spent = list[float]()
    rows = list[dict[str, Any]]()
    for view, (camera, wanted) in enumerate(zip(cameras, true, strict=True)):
        begun = clock()
        with torch.no_grad():
            picture = render(scene, camera).cpu()  # waits for a GPU
        spent.append(clock() - begun)
        picture = through_png(picture)
        rows.append(
            {
                "view": view,
                "psnr": float(psnr(picture, wanted)),
                "ssim": float(ssim(picture, wanted)),
            }
        )
        out.progress("measuring", view + 1, len(cameras))
    milliseconds = 1000 * float(np.median(spent[_WARM:] or spent))
    save_json(
        {"milliseconds": round(milliseconds, 3), "device": config.device}, out / SPEED
    )
    save_json({"gaussians": len(scene)}, out / COUNT)
    save_png(centres(scene.to("cpu"), cameras[len(cameras) // 3]), out / CENTRES)
    return rows


def centres(scene: GaussianScene, camera: Camera) -> NDArray[np.uint8]:
    """(H, W, 3) image of where the Gaussians of a splat are: a dot for each in its
    own colour, on black.
    """
    pixels, depth = project_points(scene.means, camera)
    scale = _SIZE / camera.width
    columns, rows = (pixels * scale).floor().long().unbind(1)
    height = round(camera.height * scale)
    keep = (
        (depth > 0)
        & (columns >= 0)
        & (columns < _SIZE - 1)
        & (rows >= 0)
        & (rows < height - 1)
    )
    colours = dc_to_colour(scene.sh[keep, 0]).clamp(0.15, 1).float()
    picture = torch.zeros(height, _SIZE, 3)
    for down, across in itertools.product((0, 1), repeat=2):
        picture[rows[keep] + down, columns[keep] + across] = colours
    return to_bytes(picture)
