"""The stages of a study. Each has a folder of its own, named by everything that it depends on.

A stage that is there is not done again, whichever study asks for it; one that was interrupted goes on where it stopped.
"""

from __future__ import annotations

import importlib.metadata
import shutil
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from attacks.cloak.appearances import Appearance, name_of
from attacks.cloak.mesh_scene import MeshStage, camera_number
from attacks.cloak.poisoning import Poisoned, poison, write_manifest
from attacks.cloak.study import setup
from attacks.cloak.study.config import Study, Training, essentials
from mi_splat import provenance
from mi_splat.cameras import Camera, View
from mi_splat.capture.path_tracer import scalar_variant
from mi_splat.capture.sources import Subject
from mi_splat.capture.writer import CaptureSettings, record
from mi_splat.datasets import Dataset, load_dataset
from mi_splat.datasets.writing import IMAGES, list_transforms, make_folder, picture_name
from mi_splat.io import load_splat
from mi_splat.io.documents import save_json, save_png
from mi_splat.io.images import to_bytes
from mi_splat.rendering import Renderer, RenderSettings, Watch
from mi_splat.scene import GaussianScene
from mi_splat.training.config import FitConfig, densification
from mi_splat.training.initialization import from_points, with_strays
from mi_splat.training.resume import SPLAT, train
from mi_splat.training.strategies import ClassicConfig

CLEAN, CLOAKED = "clean", "cloaked"
DONE = "done.json"
STAGES = 1
"""Part of what a stage's folder is named by; to be raised when the code makes something else of the same settings."""

OnStep = Callable[[str, int, int], None]
"""Told what is going on, how many units of it are done, and how many there are."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Workshop:
    """A study and the folder that its stages are kept in.

    Attributes:
        study: What is done.
        folder: Where stages are kept; several studies may share it.
        on_step: Told of the progress.
        stage: The attacker's copy of the scene.
        subject: The same scene as the victim's camera has it.
    """

    study: Study
    folder: Path
    on_step: OnStep = lambda text, done, total: None
    stage: MeshStage = field(init=False)
    subject: Subject = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "stage", setup.stage_of(self.study))
        object.__setattr__(self, "subject", setup.subject_for(self.study, self.stage))

    def kept(self, name: str, parts: tuple[object, ...], make: Callable[[Path], None]) -> Path:
        """The folder of a stage, which is done now if it is not there.

        Args:
            name: What the folder's name begins with.
            parts: Everything that the stage depends on.
            make: Does it, in the folder, and goes on with what an earlier call left.
        """
        path = self.folder / f"{name}-{setup.digest(name, STAGES, *parts)}"
        if not (path / DONE).is_file():
            make_folder(path)
            make(path)
            made = {"commit": provenance.commit(), "versions": provenance.versions()}
            save_json({"stage": name, "depends on": [repr(part) for part in parts], "made by": made}, path / DONE)
        return path

    # The victim's pictures, and the attacker's

    def capture(self) -> Path:
        """The victim's pictures of the scene."""
        study = self.study
        settings = CaptureSettings(samples=study.cameras.samples, alpha=True, points=study.cameras.points)
        cameras = setup.training_cameras(study, self.stage.target)

        def make(path: Path) -> None:
            record(
                self.subject,
                cameras,
                path / "set",
                settings=settings,
                on_step=lambda done, total: self.on_step("taking the victim's pictures", done, total),
            )

        # Pictures have no background of their own, but all that is made of them has.
        version = importlib.metadata.version("mitsuba")
        parts = (self.subject.digest, study.scene.background, essentials(study.cameras), version)
        return self.kept("pictures", parts, make) / "set"

    def poison(self, seed: int) -> Path:
        """The poisoned set: other files in the place of some, all others the same bytes."""
        clean = self.capture()

        def make(path: Path) -> None:
            views = self.views(clean)
            looks = setup.poisonings(
                self.study, self.stage, seed=seed, kept=lambda look: Kept(look, clean.parent / "looks")
            )
            with scalar_variant():
                done = poison(
                    views,
                    looks,
                    centre=setup.centre_of(self.study),
                    masks=self.stage.mask,
                    on_step=lambda count, total: self.on_step("poisoning", count, total),
                )
            _write_set(path / "set", views, done)

        shares = tuple(attack.share for attack in self.study.attack)
        drawn = seed if min(shares) < 1 else None  # otherwise the seed changes nothing
        attacks = tuple(map(essentials, self.study.attack))
        return self.kept("poisoned", (clean.parent.name, attacks, drawn), make) / "set"

    def views(self, path: Path) -> Dataset:
        """A set as a victim reads it."""
        return load_dataset(path, split="train", background=self.study.scene.background)

    # What the victim does with them

    def splat(self, which: str, seed: int) -> Path:
        """The file of a trained splat, clean or cloaked."""
        pictures = self.capture() if which == CLEAN else self.poison(seed)
        config, strays = fit_config(self.study.training), self.study.training.strays
        # Equal pictures make equal splats, whoever asks for them.
        parts = (pictures.parent.name, config, seed, *([("strays", strays)] if strays else []))

        def make(path: Path) -> None:
            views = self.views(pictures)
            assert views.points is not None  # a capture writes them
            cloud = with_strays(views.points, views, strays, seed=seed)
            train(
                views,
                from_points(cloud.points, cloud.colours),
                path,
                render=self.renderer(watch=isinstance(config.densification, ClassicConfig)),
                config=config,
                seed=seed,
                on_step=lambda line: self.on_step(
                    f"training the {which} splat, seed {seed}", line.iteration, config.iterations
                ),
            )

        return self.kept("splat", parts, make) / SPLAT

    def renderer(self, *, watch: bool = False) -> Renderer:
        """The renderer of trainings and of all pictures of splats."""
        settings = RenderSettings(background=self.study.scene.background)
        return Renderer(settings, watch=Watch() if watch else None)

    def load(self, which: str, seed: int) -> GaussianScene:
        """A trained splat from its file."""
        return load_splat(self.splat(which, seed))

    # What is true from cameras that no training used

    def truths(self, name: str, cameras: Sequence[Camera], look: Appearance | None) -> list[tuple[Tensor, Tensor]]:
        """Path-traced pictures, 8 bits, and the object's mask in each.

        Args:
            name: Of the stage.
            cameras: Where from.
            look: A disguise; None is the scene as it is.
        """
        numbers = [camera_number(camera) for camera in cameras]
        plain = [] if look is None else self.truths(name, cameras, None)

        def make(path: Path) -> None:
            with scalar_variant():
                for done, (number, camera) in enumerate(zip(numbers, cameras, strict=True), 1):
                    file = path / f"{number:08x}.png"
                    if not file.is_file():
                        if look is None:
                            image, mask = self.stage.picture(camera), self.stage.mask(camera)
                        else:
                            image, mask = plain[done - 1]
                            image = look(View(camera, image), mask)
                        save_png(to_rgba(image, mask[..., None].float()), file)
                    self.on_step("taking pictures to compare with", done, len(cameras))

        parts = (self.capture().parent.name, tuple(numbers), None if look is None else name_of(look))
        folder = self.kept(name, parts, make)
        return [_read(folder / f"{number:08x}.png") for number in numbers]


class Kept:
    """An appearance whose pictures are kept as files, so that they need not be made again."""

    def __init__(self, look: Appearance, folder: Path) -> None:
        self.name, self._look, self._folder = name_of(look), look, make_folder(folder)

    def __call__(self, view: View, mask: Tensor) -> Tensor:
        """The picture at 8 bits, made or read."""
        file = self._folder / f"{setup.digest(self.name)}-{camera_number(view.camera):08x}.png"
        if not file.is_file():
            save_png(to_bytes(self._look(view, mask)), file)
        with Image.open(file) as picture:
            return torch.from_numpy(np.asarray(picture.convert("RGB"), np.float32) / 255)


def fit_config(training: Training) -> FitConfig:
    """The trainer's settings."""
    return FitConfig(
        iterations=training.iterations,
        densification=densification(training.recipe, limit=training.limit, stop=training.iterations // 2),
        degree=training.degree,
        degree_every=training.degree_every,
        evaluate_every=0,
    )


def to_rgba(image: Tensor, alpha: Tensor) -> np.ndarray:
    """(H, W, 4) uint8 of colours and alpha in [0, 1]."""
    return np.concatenate([to_bytes(image), to_bytes(alpha)], axis=-1)


def _read(file: Path) -> tuple[Tensor, Tensor]:
    with Image.open(file) as picture:
        pixels = torch.from_numpy(np.asarray(picture.convert("RGBA"), np.float32) / 255)
    return pixels[..., :3], pixels[..., 3] > 0.5


def _write_set(folder: Path, clean: Dataset, done: Poisoned) -> None:
    """The poisoned set beside its manifest."""
    images = make_folder(folder / IMAGES)
    listing = []
    for index, (source, camera) in enumerate(zip(clean.paths, clean.cameras, strict=True)):
        name = picture_name("train", index)
        if index in done.views.replaced:
            save_png(to_bytes(done.views[index].image), images / name)
        else:
            shutil.copyfile(source, images / name)
        listing.append((name, camera))
    list_transforms(folder, {"train": listing}, clean.points)
    write_manifest(done, folder.parent / "manifest.json")


def snapshot(study: Study) -> dict[str, object]:
    """The study as JSON can hold it."""
    return asdict(study)
