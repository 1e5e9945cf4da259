"""A toy scene as files, studies of it, and what does them in this process."""

import dataclasses
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from attacks.detectors.base import Detector
from attacks.studies.dagger import DaggerWork
from attacks.studies.running import Work
from attacks.studies.study_file import study_of
from mi_splat.ledger import Event, Job, Store
from mi_splat.ledger.engines import InProcess
from mi_splat.ledger.plans import Driver, Result
from mi_splat.ledger.running import task_for
from mi_splat.render.renderer import RenderSettings
from mi_splat.render.scene_files import SplatScene, write_scene
from tests.fakes import CoarseDetector, ColourDetector, camera, register, toy_scene

DETECTORS: dict[str, Detector] = {
    one.name: one for one in (ColourDetector(), CoarseDetector())
}
SCENE = SplatScene(
    scene=toy_scene()[0],
    objects={"rest": slice(0, 10), "car": slice(10, 40)},
    cameras={"front": camera(), "aside": camera(offset=0.4)},
    settings=RenderSettings(background=(0.0, 0.0, 0.0), near=0.1),
)


def write_toy(folder: Path, **changes: Any) -> Path:
    """The scene, or one with other fields, as files; the path of the XML."""
    folder.mkdir(parents=True, exist_ok=True)
    scene = dataclasses.replace(SCENE, **changes)
    write_scene(scene, scene.scene, folder / "toy.xml")
    return folder / "toy.xml"


def settings(folder: Path, **changes: Any) -> dict[str, Any]:
    """The table of a study of the scene in a folder."""
    return {
        "study": "dagger",
        "scene": str(folder / "toy.xml"),
        "object": "car",
        "target": "person",
        "detectors": "fake_colour",
        "attack": {"eps": 12.0, "steps": 4, "noise_draws": 1},
        **changes,
    }


def work_of(table: Mapping[str, Any]) -> DaggerWork:
    """The jobs of a study."""
    return DaggerWork(study_of(table, "toy"))


def key_of(job: Job, store: Path) -> str:
    """The key of a job that reads files alone."""
    return task_for(job, Store(store), {}).key


def done(
    work: Work[Any], store: Path, events: list[Event] | None = None
) -> dict[str, Result]:
    """Results of all jobs, done in this process."""
    heard = [] if events is None else events
    engine = InProcess(store, on_event=heard.append)
    return Driver(engine, name=work.study.name).run(work.plans())


def running(events: list[Event]) -> int:
    """How many jobs were really done."""
    return sum(event.state == "running" for event in events)


@pytest.fixture(scope="module")
def toys() -> Iterator[None]:
    """The fake detectors, known by name like the project's own, with classes, and no
    file of weights.
    """
    with pytest.MonkeyPatch.context() as patch:
        register(patch, DETECTORS)
        yield


class Toy:
    """A classifier that takes what is red for the first of its classes."""

    name = "toy"
    fingerprint = "0123456789abcdef"
    size = 16

    def __init__(self, *classes: str) -> None:
        self.classes = classes or ("tv", "car")

    def scores(self, images: Tensor) -> Tensor:
        """Logits."""
        red = images[..., 0].mean((1, 2)) - images[..., 2].mean((1, 2))
        return 20 * torch.stack([red + 0.35, -red - 0.35], 1)
