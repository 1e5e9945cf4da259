"""A study of CLOAK that is done in seconds, and a detector of a few lines.

`python -m tests.cloak.tiny_study FOLDER` does the study, and writes beside its folder
what it has loaded.
"""

import json
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any
from unittest.mock import patch

import torch
from torch import Tensor

from attacks.cloak import setup
from attacks.cloak.config import (
    AttackConfig,
    CameraConfig,
    EvaluationConfig,
    StudyConfig,
    TrainingConfig,
)
from attacks.detectors import registry
from attacks.detectors.base import Candidates, Detections
from attacks.detectors.registry import DetectorSpec
from attacks.studies.cloak import CloakReport, config_of
from attacks.studies.running import run_with
from attacks.studies.study_file import read_study, study_of
from mi_splat.capture.mesh import Asset
from mi_splat.capture.mesh_files import load_mesh
from mi_splat.ledger import Event
from mi_splat.ledger.engines import InProcess
from scenes.recipes.objects.primitives import box

STUDY = StudyConfig(
    name="tiny",
    cameras=CameraConfig(train=16, size=40, distance=7.4, samples=2, points=1200),
    attack=(
        AttackConfig(name="overhead", elevation=(38.2, 90)),
        AttackConfig(
            name="rear",
            appearance="paint",
            texture="stop_sign",
            paint_direction=(180, 15),
            elevation=(0, 38.1),
            azimuth=(180, 45),
            target_class="stop sign",
        ),
    ),
    training=TrainingConfig(iterations=80, strategy="fixed", sh_degree_interval=0),
    evaluation=EvaluationConfig(
        detectors=("redness",),
        cameras=24,
        reference_views=2,
        meridians=1,
        meridian_step=20.0,
    ),
)


CAR = Asset("car", (box((3.4, 1.7, 1.2), (0.45, 0.2, 0.2), centre=(0, 0, 0.6)),))


def asset(file: Path) -> Asset:
    """A block in place of the car, whose meshes take most of a study's time."""
    if file.stem == "car":
        return CAR
    return load_mesh(file)


class Redness:
    """Reports a car in the middle of the image, with the more confidence the redder
    it is there.
    """

    name: str = "redness"
    classes: tuple[str, ...] = ("car", "stop sign")
    fingerprint: str = "0" * 16
    min_confidence: float = 0.0

    def candidates(self, images: Tensor) -> list[Candidates]:
        raise AssertionError("a study asks for detections only")

    def detect(self, images: Tensor) -> list[Detections]:
        detections = []
        for image in images:
            size = image.shape[0]
            middle = image[size // 3 : 2 * size // 3, size // 3 : 2 * size // 3]
            score = (6 * (middle[..., 0] - middle[..., 2]).clamp(0, 1).mean()).clamp(
                0, 1
            )
            box = torch.tensor([[size * 0.25, size * 0.3, size * 0.75, size * 0.7]])
            detections.append(Detections(box, score[None], ("car",)))
        return detections


KNOWN = {
    "redness": DetectorSpec(
        name="redness",
        load=lambda weights: Redness(),
        classes=Redness.classes,
        origin="test",
        licence="none",
    )
}
"""What makes a job find the detector by its name, where it is put into the registry."""


@contextmanager
def known() -> Iterator[None]:
    """While jobs know the detector, and a car is a block."""
    with (
        patch.dict(registry.DETECTORS.own, KNOWN),
        patch.object(setup, "_loaded", asset),
    ):
        yield


def study_in(path: Path) -> StudyConfig:
    """The one study that a file describes."""
    file = read_study(path)
    (point,) = file.points
    return config_of(point.settings, file.name)


MODULES = "modules.txt"
"""Names of all modules of this project that the study has loaded, in a file beside its
folder.
"""


def work_of(study: StudyConfig = STUDY) -> CloakReport:
    """The study as `mi-splat cloak` does it."""
    return CloakReport(study_of({**asdict(study), "study": "cloak"}, study.name))


def done(
    folder: Path,
    *,
    study: StudyConfig = STUDY,
    store: Path | None = None,
    stop_at: tuple[str, int] | None = None,
) -> tuple[dict[str, Any], list[str]]:
    """The summary of a study and the kinds of its jobs that were done; interrupted in a
    kind's step if one is named.
    """
    kinds = list[str]()

    def told(event: Event) -> None:
        if event.state == "running":
            kinds.append(event.kind.rpartition(".")[2])
        if event.state == "progress" and stop_at == (
            event.kind.rpartition(".")[2],
            event.done,
        ):
            raise KeyboardInterrupt

    torch.set_num_threads(1)
    folder.mkdir(parents=True, exist_ok=True)
    store = store or folder / "stages"
    with known():
        work = work_of(study)
        run_with(InProcess(store, on_event=told), work, out=folder)
    return summary(folder), kinds


def summary(folder: Path) -> dict[str, Any]:
    document: dict[str, Any] = json.loads((folder / "result.json").read_text())
    return document


if __name__ == "__main__":
    out = Path(sys.argv[1])
    done(out)
    loaded = [
        name for name in sys.modules if name.split(".")[0] in ("mi_splat", "attacks")
    ]
    out.with_name(MODULES).write_text("\n".join(loaded))
