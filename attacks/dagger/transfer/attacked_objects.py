"""Attacks on one object through one camera, kept as files, and what detectors report on what the files hold."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Protocol

from torch import Generator, Tensor

from attacks.dagger.attack import attack
from attacks.dagger.config import DaggerConfig
from attacks.dagger.jobs import AttackScene
from attacks.dagger.report import summary
from attacks.dagger.transfer.scenes import AttackScenes
from attacks.detectors.base import Detector
from attacks.gaussian_subset import GaussianSubset
from attacks.objectives import Objective
from attacks.observe.look import report_cells
from attacks.observe.rows import Cell
from attacks.observe.views import detect_views, object_boxes
from mi_splat.attributes import ATTRIBUTES
from mi_splat.cameras import Camera, RenderFn
from mi_splat.errors import InvalidValueError, message
from mi_splat.io import load_splat, save_splat
from mi_splat.io.documents import sha256
from mi_splat.scene import GaussianScene

ATTACKED = "attacked"
"""Folder of the attacked objects."""


class ObjectAttack(Protocol):
    """What is attacked, and how."""

    @property
    def name(self) -> str:
        """File name, unique within a study."""
        ...

    @property
    def scene(self) -> str:
        """Name of the scene file without its suffix."""
        ...

    @property
    def object(self) -> str:
        """Id of the object; with spaces for its underscores it is the object's class."""
        ...

    @property
    def target(self) -> str:
        """Class wanted."""
        ...

    @property
    def camera(self) -> int:
        """Position of the camera in the order of the scene file."""
        ...

    @property
    def config(self) -> DaggerConfig:
        """The rest. Its seed also moves the camera, see `attacks.dagger.jobs.jittered`."""
        ...


class AttackedObjects:
    """Attacks objects, and shows what is left of them to detectors; scenes are read and detectors loaded once.

    Args:
        read: Finds a scene by its name.
        load: Loads a detector by its name.
        out: Folder of the study.

    Attributes:
        detector: Finds a detector by its name.
    """

    def __init__(self, read: Callable[[str], AttackScene], load: Callable[[str], Detector], out: Path) -> None:
        self.detector: Callable[[str], Detector] = functools.cache(load)
        self._scenes, self._out = AttackScenes(read), out
        self._boxes: dict[tuple[str, str, int, int], Tensor] = {}
        self._clean: dict[tuple[object, ...], dict[str, Cell]] = {}

    def place(self, job: ObjectAttack) -> AttackScene:
        """The scene of an attack, which has its object."""
        return self._scenes.of(job.scene, job.object)

    def view(self, job: ObjectAttack) -> Camera:
        """The camera of an attack, moved by its seed."""
        return self._scenes.view(job.scene, job.object, job.config.seed, job.camera)

    def path(self, job: ObjectAttack) -> Path:
        """File of the attacked object."""
        return self._out / ATTACKED / f"{job.name}.ply"

    def fingerprint(self, job: ObjectAttack, detectors: Sequence[str]) -> str:
        """Hash of the scene, its cameras and the weights of the detectors."""
        return self._scenes.fingerprint(job.scene, job.object, *map(self.detector, detectors))

    def look_fingerprint(self, job: ObjectAttack, detectors: Sequence[str]) -> str:
        """The same, with the attacked object as its file has it: what is made anew is looked at anew."""
        path = self.path(job)
        content = sha256(path) if path.is_file() else "not there"
        return f"{self.fingerprint(job, detectors)} {content}"

    def attack(
        self, job: ObjectAttack, detectors: Sequence[str], objective: Objective, *, render: RenderFn
    ) -> dict[str, Any]:
        """Attack, save the object's Gaussians, and return the summary without its views.

        Args:
            job: What is attacked.
            detectors: Names of those that are to be deceived.
            objective: What they shall see.
            render: What makes the attacker's pictures.
        """
        place = self.place(job)
        rows = place.objects[job.object]
        found = attack(
            place.scene,
            rows,
            [self.view(job)],
            list(map(self.detector, detectors)),
            objective,
            render=render,
            config=job.config,
        )
        self.path(job).parent.mkdir(parents=True, exist_ok=True)
        save_splat(found.scene.select(rows), self.path(job))
        left_out = ("views", "zero_gradient_fraction", "trace", "noise")
        return {name: value for name, value in summary(found).items() if name not in left_out}

    def seen(
        self, job: ObjectAttack, detector: str, *, render: RenderFn, condition: str = ""
    ) -> dict[str, dict[str, Cell]]:
        """What a detector reports on the object: clean, attacked, and with random noise of the attack's size.

        Args:
            job: The attack, which has left its file.
            detector: Name of the one that looks.
            render: What makes its pictures.
            condition: What these pictures are called, if there are several kinds.

        Returns:
            For each of the three the cells of `attacks.observe.look.report_cells`.
        """
        place, config = self.place(job), job.config
        saved = load_splat(self.path(job))
        clean, attacked = clean_and_attacked(place.scene, place.objects[job.object], saved, config.attributes)
        reference, moved = (subset.parameters(config.attributes) for subset in (clean, attacked))
        noisy = clean.applied(config.budget.noise(moved, reference, Generator().manual_seed(config.seed + 1)))
        look = functools.partial(self._reported, job=job, detector=self.detector(detector), render=render)
        key = (job.scene, job.object, job.target, job.camera, config.seed, detector, condition, clean.scene.degree)
        if key not in self._clean:
            self._clean[key] = look(clean.scene)
        return {"clean": self._clean[key], "attacked": look(attacked.scene), "noise": look(noisy)}

    def _reported(
        self, scene: GaussianScene, *, job: ObjectAttack, detector: Detector, render: RenderFn
    ) -> dict[str, Cell]:
        camera, box = self.view(job), self._box(job)
        (view,) = detect_views(scene, [camera], [detector], render=render, boxes=[box])
        return report_cells(view.detections, box, original=job.object.replace("_", " "), target=job.target)

    def _box(self, job: ObjectAttack) -> Tensor:
        """Where the clean object is in the scene's own picture."""
        key = (job.scene, job.object, job.camera, job.config.seed)
        if key not in self._boxes:
            place = self.place(job)
            (box,) = object_boxes(place.scene, place.objects[job.object], [self.view(job)], render=place.render)
            if box is None:
                do = "choose another seed"
                raise InvalidValueError(message(job.name, "a view that shows the object", "none of it", do))
            self._boxes[key] = box
        return self._boxes[key]


def clean_and_attacked(
    scene: GaussianScene, rows: slice, saved: GaussianScene, attributes: Sequence[str]
) -> tuple[GaussianSubset, GaussianSubset]:
    """An object in the clean scene, with as many coefficients as the attacked one has, and in the attacked scene.

    Args:
        scene: The clean scene.
        rows: The object.
        saved: Its Gaussians after the attack, as they were loaded from their file.
        attributes: What of them was attacked; all else is taken from the clean scene.
    """
    clean = GaussianSubset.of(scene.with_degree(max(saved.degree, scene.degree)), rows)
    values = {
        name: whole.clone().index_put((clean.rows,), part)
        for name, whole, part in zip(ATTRIBUTES, clean.scene.tensors(), saved.tensors(), strict=True)
        if name in attributes
    }
    return clean, GaussianSubset.of(clean.scene.replace(**values), rows)
