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
from attacks.cloak.mesh_scene import MeshScene, camera_number
from attacks.cloak.poisoning import Poisoned, poison, write_manifest
from attacks.cloak.study import setup
from attacks.cloak.study.config import StudyConfig, TrainingConfig, essentials
from mi_splat import provenance
from mi_splat.cameras import Camera, View
from mi_splat.capture.path_tracer import scalar_variant
from mi_splat.capture.sources import CaptureSource
from mi_splat.capture.writer import CaptureSettings, write_capture
from mi_splat.datasets import Dataset, load_dataset
from mi_splat.datasets.writing import IMAGES, list_transforms, make_folder, picture_name
from mi_splat.io import load_splat
from mi_splat.io.documents import save_json, save_png
from mi_splat.io.images import to_bytes
from mi_splat.rendering import Renderer, RenderSettings, ScreenGradients
from mi_splat.scene import GaussianScene
from mi_splat.training.config import FitConfig
from mi_splat.training.initialization import from_points, with_outliers
from mi_splat.training.resume import SPLAT, train
from mi_splat.training.strategies import strategy_config

CLEAN, CLOAKED = "clean", "cloaked"
DONE = "done.json"
STAGES = 1
"""Part of what a stage's folder is named by; to be raised when the code makes something else of the same settings."""

OnStep = Callable[[str, int, int], None]
"""Told what is going on, how many units of it are done, and how many there are."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class StudyPipeline:
    """A study and the folder that its stages are kept in.

    Attributes:
        study: What is done.
        folder: Where stages are kept; several studies may share it.
        on_step: Told of the progress.
        mesh_scene: The attacker's copy of the scene.
        source: The same scene as the victim's camera has it.
    """

    study: StudyConfig
    folder: Path
    on_step: OnStep = lambda text, done, total: None
    mesh_scene: MeshScene = field(init=False)
    source: CaptureSource = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "mesh_scene", setup.mesh_scene_of(self.study))
        object.__setattr__(self, "source", setup.capture_source(self.study, self.mesh_scene))

    def cached(self, name: str, parts: tuple[object, ...], make: Callable[[Path], None]) -> Path:
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
        cameras = setup.training_cameras(study, self.mesh_scene.target)

        def make(path: Path) -> None:
            write_capture(
                self.source,
                cameras,
                path / "set",
                settings=settings,
                on_step=lambda done, total: self.on_step("taking the victim's pictures", done, total),
            )

        # Pictures have no background of their own, but all that is made of them has.
        version = importlib.metadata.version("mitsuba")
        parts = (self.source.digest, study.scene.background, essentials(study.cameras), version)
        return self.cached("pictures", parts, make) / "set"

    def poison(self, seed: int) -> Path:
        """The poisoned set: other files in the place of some, all others the same bytes."""
        clean = self.capture()

        def make(path: Path) -> None:
            views = self.views(clean)
            appearances = setup.poisonings(
                self.study,
                self.mesh_scene,
                seed=seed,
                cached=lambda appearance: CachedAppearance(appearance, clean.parent / "appearances"),
            )
            with scalar_variant():
                done = poison(
                    views,
                    appearances,
                    centre=setup.centre_of(self.study),
                    masks=self.mesh_scene.mask,
                    on_step=lambda count, total: self.on_step("poisoning", count, total),
                )
            _write_set(path / "set", views, done)

        fractions = tuple(attack.poison_fraction for attack in self.study.attack)
        drawn = seed if min(fractions) < 1 else None  # otherwise the seed changes nothing
        attacks = tuple(map(essentials, self.study.attack))
        return self.cached("poisoned", (clean.parent.name, attacks, drawn), make) / "set"

    def views(self, path: Path) -> Dataset:
        """A set as a victim reads it."""
        return load_dataset(path, split="train", background=self.study.scene.background)

    # What the victim does with them

    def splat(self, which: str, seed: int) -> Path:
        """The file of a trained splat, clean or cloaked."""
        pictures = self.capture() if which == CLEAN else self.poison(seed)
        config, outliers = fit_config(self.study.training), self.study.training.outliers
        # Equal pictures make equal splats, whoever asks for them.
        parts = (pictures.parent.name, config, seed, *([("outliers", outliers)] if outliers else []))

        def make(path: Path) -> None:
            views = self.views(pictures)
            assert views.points is not None  # a capture writes them
            cloud = with_outliers(views.points, views, outliers, seed=seed)
            train(
                views,
                from_points(cloud.points, cloud.colours),
                path,
                render=self.renderer(screen_gradients=config.strategy.needs_screen_gradients),
                config=config,
                seed=seed,
                on_step=lambda line: self.on_step(
                    f"training the {which} splat, seed {seed}", line.iteration, config.iterations
                ),
            )

        return self.cached("splat", parts, make) / SPLAT

    def renderer(self, *, screen_gradients: bool = False) -> Renderer:
        """The renderer of trainings and of all pictures of splats."""
        settings = RenderSettings(background=self.study.scene.background)
        return Renderer(settings, screen_gradients=ScreenGradients() if screen_gradients else None)

    def load(self, which: str, seed: int) -> GaussianScene:
        """A trained splat from its file."""
        return load_splat(self.splat(which, seed))

    # What is true from cameras that no training used

    def truths(
        self, name: str, cameras: Sequence[Camera], appearance: Appearance | None
    ) -> list[tuple[Tensor, Tensor]]:
        """Path-traced pictures, 8 bits, and the object's mask in each.

        Args:
            name: Of the stage.
            cameras: Where from.
            appearance: An appearance; None is the scene as it is.
        """
        numbers = [camera_number(camera) for camera in cameras]
        plain = [] if appearance is None else self.truths(name, cameras, None)

        def make(path: Path) -> None:
            with scalar_variant():
                for done, (number, camera) in enumerate(zip(numbers, cameras, strict=True), 1):
                    file = path / f"{number:08x}.png"
                    if not file.is_file():
                        if appearance is None:
                            image, mask = self.mesh_scene.picture(camera), self.mesh_scene.mask(camera)
                        else:
                            image, mask = plain[done - 1]
                            image = appearance(View(camera, image), mask)
                        save_png(to_rgba(image, mask[..., None].float()), file)
                    self.on_step("taking pictures to compare with", done, len(cameras))

        parts = (self.capture().parent.name, tuple(numbers), None if appearance is None else name_of(appearance))
        folder = self.cached(name, parts, make)
        return [_read(folder / f"{number:08x}.png") for number in numbers]


class CachedAppearance:
    """An appearance whose pictures are kept as files, so that they need not be made again."""

    def __init__(self, appearance: Appearance, folder: Path) -> None:
        self.name, self._look, self._folder = name_of(appearance), appearance, make_folder(folder)

    def __call__(self, view: View, mask: Tensor) -> Tensor:
        """The picture at 8 bits, made or read."""
        file = self._folder / f"{setup.digest(self.name)}-{camera_number(view.camera):08x}.png"
        if not file.is_file():
            save_png(to_bytes(self._look(view, mask)), file)
        with Image.open(file) as picture:
            return torch.from_numpy(np.asarray(picture.convert("RGB"), np.float32) / 255)


def fit_config(training: TrainingConfig) -> FitConfig:
    """The trainer's settings."""
    return FitConfig(
        iterations=training.iterations,
        strategy=strategy_config(training.strategy, max_gaussians=training.max_gaussians),
        sh_degree=training.sh_degree,
        sh_degree_interval=training.sh_degree_interval,
        eval_interval=0,
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


def snapshot(study: StudyConfig) -> dict[str, object]:
    """The study as JSON can hold it."""
    return asdict(study)
