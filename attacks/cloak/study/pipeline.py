"""The work of a study, step by step as the paper has it: capture, poison, train; `observations` looks at the result."""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from attacks.cloak import setup
from attacks.cloak.appearances import Appearance
from attacks.cloak.config import AttackConfig, StudyConfig, SurrogateConfig
from attacks.cloak.layers import layer_object
from attacks.cloak.mesh_scene import MeshScene
from attacks.cloak.poisoning import Poisoned, poison, write_manifest
from attacks.cloak.study import dependencies
from attacks.cloak.study.cache import Stage, StageCache
from attacks.cloak.study.dependencies import fit_config, layered_fit_config
from attacks.cloak.study.kept_pictures import CachedAppearance, TruePictures, kept_renders, read_rgba, to_rgba
from attacks.cloak.study.trained_splats import TrainedSplat, cleaned_splat, starting_cloud, trained_splat
from mi_splat.cameras import Camera, RenderFn, View
from mi_splat.capture.path_tracer import scalar_variant
from mi_splat.capture.settings import CaptureSettings
from mi_splat.capture.sources import CaptureSource
from mi_splat.capture.writer import write_capture
from mi_splat.datasets import Dataset, load_dataset
from mi_splat.datasets.writing import IMAGES, list_transforms, make_folder, picture_name
from mi_splat.io.documents import save_png
from mi_splat.io.images import to_bytes
from mi_splat.rendering import Renderer, RenderSettings, ScreenGradients
from mi_splat.training.initialization import from_points
from mi_splat.training.resume import SPLAT, train

CLEAN, CLOAKED = "clean", "cloaked"
SET, MANIFEST = "set", "manifest.json"

OnStep = Callable[[str, int, int], None]
"""Told what is going on, how many units of it are done, and how many there are."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PictureSet:
    """A set of training pictures on the disk.

    Attributes:
        folder: Of the stage; the pictures and their cameras are in its folder `set`.
        content: SHA-256 of the set.
    """

    folder: Path
    content: str


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class StudyPipeline:
    """A study and the folder that its stages are kept in.

    Attributes:
        study: What is done.
        folder: Where stages are kept; several studies may share it.
        on_step: Told of the progress.
        begun: When, in seconds of `time.monotonic`.
        mesh_scene: The attacker's copy of the scene.
        source: The same scene as the victim's camera has it.
        cache: The stages in the folder.
    """

    study: StudyConfig
    folder: Path
    on_step: OnStep = lambda text, done, total: None
    begun: float = field(default_factory=time.monotonic)
    mesh_scene: MeshScene = field(init=False)
    source: CaptureSource = field(init=False)
    cache: StageCache = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "mesh_scene", setup.mesh_scene_of(self.study))
        object.__setattr__(self, "source", setup.capture_source(self.study, self.mesh_scene))
        object.__setattr__(self, "cache", StageCache(self.folder))

    # The five steps are these three, `observations.observe` and `report.write_report`.

    def capture(self) -> PictureSet:
        """The victim's pictures of the scene."""
        study = self.study
        settings = CaptureSettings(samples=study.cameras.samples, rgba=True, points=study.cameras.points)
        cameras = setup.training_cameras(study, self.mesh_scene.target)

        def make(path: Path) -> None:
            write_capture(
                self.source,
                cameras,
                path / SET,
                settings=settings,
                on_step=lambda done, total: self.on_step("taking the victim's pictures", done, total),
            )

        depends_on = dependencies.of_pictures(study, self.source.digest)
        return _picture_set(self.cache.finished("pictures", depends_on, make, outputs=(f"{SET}/**/*",)))

    def poison(self, clean: PictureSet) -> dict[int, PictureSet]:
        """The poisoned set of each seed: other files in the place of some, all others the same bytes."""
        return {seed: self._poison(clean, seed) for seed in self.study.seeds}

    def train(self, clean: PictureSet, poisoned: Mapping[int, PictureSet]) -> list[TrainedSplat]:
        """For each seed the splat that the victim makes of the clean pictures, and a cloaked one.

        The cloaked one is what the victim makes of the poisoned pictures. In a study of layers it is the clean splat's
        file, changed by who hands it on. In a study with a cleaning the victim cleans both.
        """
        found: list[TrainedSplat] = []
        for seed in self.study.seeds:
            first = self._train(CLEAN, clean, seed)
            found += [first, self._train(CLOAKED, poisoned[seed], seed, None if not self.study.layers else first)]
        cleaning = self.study.cleaning
        return found if cleaning is None else [cleaned_splat(splat, cleaning, self.cache) for splat in found]

    def renderer(self, *, screen_gradients: bool = False) -> Renderer:
        """The renderer of trainings and of all pictures of splats."""
        near = setup.near_of(self.study, self.mesh_scene.target)
        settings = RenderSettings(background=self.study.scene.background, near=near)
        return Renderer(settings, screen_gradients=ScreenGradients() if screen_gradients else None)

    def views(self, pictures: PictureSet) -> Dataset:
        """A set as a victim reads it."""
        return load_dataset(pictures.folder / SET, split="train", background=self.study.scene.background)

    def _poison(self, clean: PictureSet, seed: int, surrogates: tuple[TrainedSplat, ...] = ()) -> PictureSet:
        """A poisoned set, corrected by surrogates: those given, or as many as the study asks for."""
        config = self.study.surrogate
        if config is not None and len(surrogates) < config.rounds:
            before = self._poison_with(clean, seed, surrogates)
            return self._poison(clean, seed, (*surrogates, self._surrogate(before, config)))
        return self._poison_with(clean, seed, surrogates)

    def _surrogate(self, poisoned: PictureSet, config: SurrogateConfig) -> TrainedSplat:
        """A splat of the attacker's own."""
        training = replace(self.study.training, iterations=config.iterations)
        own = StudyPipeline(
            study=replace(self.study, training=training, surrogate=None, layers=None),
            folder=self.folder,
            on_step=self.on_step,
        )
        return own._train("surrogate", poisoned, config.seed)

    def _poison_with(self, clean: PictureSet, seed: int, surrogates: tuple[TrainedSplat, ...]) -> PictureSet:
        def make(path: Path) -> None:
            views = self.views(clean)
            poisonings = setup.poisonings(
                self.study,
                self.mesh_scene,
                seed=seed,
                cached=self.cached_appearance,
                surrogates=[kept_renders(splat.load(), self.renderer()) for splat in surrogates],
            )
            with scalar_variant():
                done = poison(
                    views,
                    poisonings,
                    centre=setup.centre_of(self.study),
                    masks=self.mesh_scene.mask,
                    on_step=lambda count, total: self.on_step("poisoning", count, total),
                )
            _write_set(path, views, done)

        depends_on = dependencies.of_poisoned(
            self.study, self.source.digest, clean.content, seed, [splat.content for splat in surrogates]
        )
        return _picture_set(self.cache.finished("poisoned", depends_on, make, outputs=(f"{SET}/**/*",)))

    def cached_appearance(self, appearance: Appearance, attack: AttackConfig) -> CachedAppearance:
        """An attack's appearance, each of whose pictures is made once."""
        depends_on = dependencies.of_appearance(self.study, self.source.digest, attack)
        return CachedAppearance(appearance, self.cache.folder("appearance", depends_on))

    def _train(self, which: str, pictures: PictureSet, seed: int, clean: TrainedSplat | None = None) -> TrainedSplat:
        """A splat of a set; of a clean splat its layers, trained on the set."""
        study = self.study
        config = fit_config(study.training) if clean is None else layered_fit_config(study)

        def make(path: Path) -> None:
            found = self.views(pictures)
            views: Sequence[View] = found
            render: RenderFn = self.renderer(screen_gradients=config.strategy.needs_screen_gradients)
            if clean is None:
                assert found.points is not None  # a capture writes them
                cloud = starting_cloud(study.training, found.points, found, seed=seed)
                start = from_points(cloud.points, cloud.colours)
            else:
                self.on_step(f"making the layers, seed {seed}", 0, 1)
                layering = layer_object(study, clean.load(), self.mesh_scene.target, found, render=render)
                start, views, render = layering.scene, layering.views, layering.rendered_by(render)
            train(
                views,
                start,
                path,
                render=render,
                config=config,
                seed=seed,
                on_step=lambda line: self.on_step(
                    f"training the {which} splat, seed {seed}", line.iteration, config.iterations
                ),
            )

        if clean is None:
            stage = self.cache.finished(
                "splat", dependencies.of_splat(study, pictures.content, seed), make, outputs=(SPLAT,)
            )
        else:
            depends_on = dependencies.of_layers(study, self.source.digest, clean.content, pictures.content, seed)
            stage = self.cache.finished("layers", depends_on, make, outputs=(SPLAT,))
        return trained_splat(which, seed, stage)

    def true_pictures(self, cameras: Sequence[Camera], attack: AttackConfig | None = None) -> TruePictures:
        """Path-traced pictures from cameras that no training used.

        Args:
            cameras: Where from.
            attack: Whose appearance the object has; None is the scene as it is.
        """
        plain = None if attack is None else self.true_pictures(cameras)
        appearance = None if attack is None else setup.appearance_of(self.study, attack, self.mesh_scene)

        def make(path: Path) -> None:
            with scalar_variant():
                for number, camera in enumerate(cameras):
                    file = path / f"{number:04d}.png"
                    if not file.is_file():
                        if plain is None or appearance is None:
                            image, mask = self.mesh_scene.picture(camera), self.mesh_scene.mask(camera)
                        else:
                            image, mask = plain.images[number], plain.masks[number]
                            image = appearance(View(camera, image), mask)
                        save_png(to_rgba(image, mask[..., None].float()), file)
                    self.on_step("taking pictures to compare with", number + 1, len(cameras))

        depends_on = dependencies.of_true_pictures(self.study, self.source.digest, cameras, attack)
        stage = self.cache.finished("true_pictures", depends_on, make, outputs=("*.png",))
        pairs = [read_rgba(stage.folder / f"{number:04d}.png") for number in range(len(cameras))]
        return TruePictures(
            images=tuple(image for image, _ in pairs),
            masks=tuple(alpha > 0.5 for _, alpha in pairs),
            content=stage.content,
        )


def _picture_set(stage: Stage) -> PictureSet:
    return PictureSet(folder=stage.folder, content=stage.content)


def _write_set(folder: Path, clean: Dataset, done: Poisoned) -> None:
    """The poisoned set, and beside it the manifest."""
    images = make_folder(folder / SET / IMAGES)
    listing = []
    for index, (source, camera) in enumerate(zip(clean.paths, clean.cameras, strict=True)):
        name = picture_name("train", index)
        if index in done.views.replaced:
            save_png(to_bytes(done.views[index].image), images / name)
        else:
            shutil.copyfile(source, images / name)
        listing.append((name, camera))
    list_transforms(folder / SET, {"train": listing}, clean.points)
    write_manifest(done, folder / MANIFEST)
