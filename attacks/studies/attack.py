"""One attack of a study: an object attacked from some of its scene's cameras, or from
all cameras of a region.

What it leaves: result.json as `mi-splat dagger` writes it, an image of what was
reported before and after, and the splat: object.ply has the object's Gaussians alone,
attacked.ply of a region the whole scene.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Generator

from attacks.dagger.attack import attack_views
from attacks.dagger.config import DaggerConfig
from attacks.dagger.problem import counted_from
from attacks.dagger.report import before_and_after, summary, write_files
from attacks.dagger.views import DrawnViews, FixedViews
from attacks.detectors.base import Detector
from attacks.detectors.registry import load_detector
from attacks.objectives import PluggedObjective
from attacks.objectives.relabel import Relabel
from attacks.objectives.suppression import Hide, Untargeted
from attacks.observe.conditions import SunTable, check_condition, renderer_of
from attacks.search.loop import Step
from attacks.transformations.config import CameraCone, Transformations
from mi_splat.cameras.camera import Camera, RenderFn
from mi_splat.cameras.directions import Point
from mi_splat.comparison.methods import RENDERERS
from mi_splat.errors import InvalidValueError
from mi_splat.fields import check_choice
from mi_splat.io import save_splat
from mi_splat.io.camera_records import recorded_cameras
from mi_splat.io.documents import save_json, save_png
from mi_splat.io.folders import RECORD
from mi_splat.io.scene_parts import SceneParts
from mi_splat.render.scene_files import SplatScene, read_scene
from mi_splat.scene import GaussianScene

if TYPE_CHECKING:
    from torch import Tensor

    from attacks.studies.look import Look
    from mi_splat.ledger import Out


class AttackScene(SplatScene):
    """A scene ready for attacks."""

    def centre(self, name: str) -> Point:
        """(3,) mean of an object's Gaussians, world units."""
        x, y, z = self.scene.means[self.objects[name]].mean(0).tolist()
        return x, y, z

    def views(self, name: str, *, camera: int, count: int, seed: int) -> list[Camera]:
        """Cameras of the scene, moved about an object as `jittered` does."""
        centre = self.scene.means[self.objects[name]].mean(0)
        return [
            jittered(view, centre, seed=seed)
            for view in [*self.cameras.values()][camera:][: count or None]
        ]

    def attacked(
        self,
        name: str,
        inputs: Mapping[str, Path],
        *,
        camera: int,
        count: int,
        seed: int,
    ) -> list[Camera]:
        """The same, or cameras of a job's file as they stand there."""
        if CAMERAS not in inputs:
            return self.views(name, camera=camera, count=count, seed=seed)
        return [*cameras_in(inputs[CAMERAS]).values()][camera:][: count or None]

    def renderer(self, name: str) -> RenderFn:
        """A renderer by its name, as in `mi-splat compare`, with the scene's settings;
        "" is the scene's own.
        """
        return renderer_of(name, self.settings)


def attack_scene(path: Path) -> AttackScene:
    """A scene XML ready for attacks; read once as long as its files are the same."""
    return _read(path, tuple(_state(file) for file in scene_files(path).values()))


@functools.lru_cache(maxsize=4)
def _read(path: Path, state: object) -> AttackScene:
    scene = read_scene(path)
    return AttackScene(
        scene=scene.scene,
        objects=scene.objects,
        cameras=scene.cameras,
        settings=scene.settings,
    )


def detectors_of(names: tuple[str, ...], inputs: Mapping[str, Path]) -> list[Detector]:
    """The detectors of a job, each loaded once as long as its weights are the same."""
    return [
        _detector(
            name,
            _state(inputs[f"weights {name}"]) if f"weights {name}" in inputs else None,
        )
        for name in names
    ]


@functools.lru_cache(maxsize=8)
def _detector(name: str, state: object) -> Detector:
    return load_detector(name)


def _state(file: Path) -> tuple[str, int, int]:
    status = file.stat()
    return str(file), status.st_mtime_ns, status.st_size


def scene_files(path: Path) -> dict[str, Path]:
    """A scene file and all that it names, as inputs of a job; read once as long as the
    file is the same.
    """
    files = dict.fromkeys(_parts(path, _state(path) if path.is_file() else None).files)
    return {
        f"scene {number}" if number else "scene": file
        for number, file in enumerate(files)
    }


def street_of(
    condition: str, sun: SunTable | None
) -> tuple[SunTable | None, dict[str, Path]]:
    """The street of a condition that is an hour, and its files as inputs of a job; none
    of another condition.
    """
    check_condition(condition, sun)
    if sun is None or ":" not in condition:
        return None, {}
    return sun, {
        f"street {name}": path for name, path in scene_files(Path(sun.scene)).items()
    }


def cameras_in(path: Path) -> dict[str, Camera]:
    """The cameras of a file, by name; read once as long as the file is the same."""
    cameras = _recorded(path, _state(path)) if path.is_file() else None
    if not cameras:
        do = "write one with scenes.recipes.drawn_cameras"
        raise InvalidValueError.of("cameras", "a JSON file with cameras", str(path), do)
    return dict(cameras)


@functools.lru_cache(maxsize=64)
def _recorded(path: Path, state: object) -> dict[str, Camera] | None:
    return recorded_cameras(path)


@functools.lru_cache(maxsize=64)
def _parts(path: Path, state: object) -> SceneParts:
    return SceneParts(path)


def check_scene(
    path: Path,
    name: str,
    *,
    camera: int = 0,
    cameras: Path | None = None,
    renderers: Sequence[str] = (),
) -> None:
    """Raise unless a scene file has an object and a camera, and there are renderers;
    nothing is loaded.
    """
    elements = _parts(path, _state(path) if path.is_file() else None).elements
    objects = [
        str(part.get("id"))
        for part in elements
        if part.tag == "shape" and part.get("type") == "gaussians"
    ]
    check_choice(f"object of {path}", name, objects)
    if cameras is None:
        count = sum(part.tag == "sensor" for part in elements)
    else:
        count = len(cameras_in(cameras))
    if camera >= count:
        raise InvalidValueError.of(
            f"camera of {cameras or path}",
            f"0 to {count - 1}",
            camera,
            "choose another",
        )
    for renderer in filter(None, renderers):
        check_choice("renderer", renderer, RENDERERS)


def jittered(camera: Camera, centre: torch.Tensor, *, seed: int) -> Camera:
    """The camera turned about the vertical axis through `centre` and moved along the
    line to it.

    It turns by at most 6 degrees, and its distance changes by at most 5 %. Seed 0
    changes nothing.
    """
    if seed == 0:
        return camera
    turn, move = (
        2 * torch.rand(2, generator=Generator().manual_seed(seed), dtype=torch.float64)
        - 1
    ).tolist()
    angle = math.radians(6 * turn)
    pivot = centre.detach().to("cpu", torch.float64)
    spin = torch.eye(3, dtype=torch.float64)
    spin[:2, :2] = torch.tensor(
        [[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]]
    )
    pose = camera.to_world.clone()
    pose[:3, :3] = spin @ pose[:3, :3]
    pose[:3, 3] = pivot + (1 + 0.05 * move) * (spin @ (camera.position - pivot))
    return dataclasses.replace(camera, to_world=pose)


VARIES = (RECORD,)
CAMERAS = "cameras"
"""The input that is a file of cameras, in the place of the scene's own."""
SPLAT = "object.ply"
WHOLE_SPLAT = "attacked.ply"
PICTURE = "detections.png"


@dataclass(frozen=True, slots=True, kw_only=True)
class Attack:
    """One attack, from some cameras of the scene or of a file, or from all cameras of a
    region.
    """

    object: str  # id of the object
    # what the detectors shall see
    objective: Relabel | Hide | Untargeted | PluggedObjective
    detectors: tuple[str, ...] = ("fasterrcnn_small",)  # attacked at once
    fingerprints: tuple[str, ...] = ()  # of the detectors whose weights are in no file
    # that bring the optimiser and the renderers; empty for this project
    packages: tuple[str, ...] = ()
    # its seed also moves the scene's cameras: `jittered`
    attack: DaggerConfig = field(default_factory=DaggerConfig)
    # position of the first camera that is attacked, in the order of its file
    camera: int = 0
    # cameras that are attacked together, from that one on; 0 is all of them
    views: int = 1
    renderer: str = ""  # whose images the attacker looks at; "" is the scene's own
    # whose gradient the attacker follows; "" is that of the images
    gradient: str = ""
    # whether cameras are passed over from which a detector does not report the clean
    # object as what it is, which no rate counts: one step, and no controls
    only_detected: bool = False
    # the views of a region that it is made for; None is cameras
    transformations: Transformations | None = None
    # where the held-out views of a region are drawn from, if elsewhere
    evaluation: Transformations | None = None


def run(config: Attack, inputs: Mapping[str, Path], out: Out) -> list[dict[str, Any]]:
    """Attack, and write what comes of it."""
    scene = attack_scene(inputs["scene"])
    seed = config.attack.seed
    rows = scene.objects[config.object]
    fixed = config.transformations is None
    search = config.attack
    detectors = detectors_of(config.detectors, inputs)
    if config.transformations is None:
        cameras = scene.attacked(
            config.object, inputs, camera=config.camera, count=config.views, seed=seed
        )
        render = attackers_renderer(scene, config.renderer, config.gradient)
        views = FixedViews(scene.scene, rows, cameras, render=render)
        if config.only_detected and not _is_detected(config, views, detectors):
            search = dataclasses.replace(search, steps=1, noise_draws=0)
    else:
        views = drawn_views(scene, config, inputs, config.transformations)
        if config.only_detected and not _is_detected(config, views, detectors):
            search = dataclasses.replace(search, steps=1, noise_draws=0, ladder=())

    def follow(step: Step) -> None:
        out.progress("attacking", step.index, search.steps)

    result = attack_views(
        views,
        detectors,
        config.objective,
        config=search,
        evaluation=(
            None
            if config.evaluation is None
            else drawn_views(scene, config, inputs, config.evaluation)
        ),
        on_step=follow,
    )
    if fixed:
        named = len(result.detectors) > 1
        save_png(
            np.concatenate(
                [before_and_after(view, named=named) for view in result.views]
            ),
            out / PICTURE,
        )
        save_splat(result.scene.select(rows), out / SPLAT)
        save_json(summary(result), out / RECORD)
    else:
        write_files(result, out.files)
    return list(result.looked.rows.iter_rows(named=True))


def _is_detected(
    config: Attack, views: FixedViews, detectors: Sequence[Detector]
) -> bool:
    """Whether every detector reports the clean object as what it is, in every view from
    a chosen camera, or in half of the views around it.
    """
    name = config.object.replace("_", " ")
    drawn = views.transformations is not None
    looked = views.validation(config.attack)
    reports = views.clean_reports(detectors, looked)
    least = {one.name: counted_from(config.objective, one) for one in detectors}
    label_of = views.originals(detectors, config.attack, least)
    for detector in detectors:
        found = [
            reports[view.index, detector.name].confidence(name) >= least[detector.name]
            and label_of(view, detector.name) == name
            for view in looked
        ]
        if sum(found) < len(found) * (0.5 if drawn else 1.0):
            return False
    return True


def drawn_views(
    scene: AttackScene,
    config: Attack | Look,
    inputs: Mapping[str, Path],
    transformations: Transformations,
) -> DrawnViews:
    """The views of a job's object, drawn from a region or around one of its cameras."""
    if isinstance(transformations.cameras, CameraCone):
        (camera,) = scene.attacked(
            config.object, inputs, camera=config.camera, count=1, seed=0
        )
    else:
        camera = next(iter(scene.cameras.values()))
    return distribution(scene, config.object, camera, transformations)


@functools.lru_cache(maxsize=4)
def distribution(
    scene: AttackScene, name: str, reference: Camera, transformations: Transformations
) -> DrawnViews:
    """The views of an object; drawn once for all jobs of a process."""
    return DrawnViews(
        scene.scene,
        scene.objects[name],
        reference,
        transformations,
        render=scene.renderer(""),
    )


def attackers_renderer(scene: AttackScene, renderer: str, gradient: str) -> RenderFn:
    """What makes the attacker's images, with the gradient of another renderer if one
    is named.
    """
    picture = scene.renderer(renderer)
    same = gradient in ("", renderer)
    if same:
        return picture
    return with_gradient_of(scene.renderer(gradient), picture)


def with_gradient_of(gradient: RenderFn, picture: RenderFn) -> RenderFn:
    """The images of `picture`, through which autograd goes as through those of
    `gradient`.

    A derivative of the loss by the pixels is therefore that at the image that is
    shown; the derivative of the pixels by the Gaussians is the other renderer's.
    """

    def rendered(scene: GaussianScene, camera: Camera) -> Tensor:
        with torch.no_grad():
            shown = picture(scene.detach(), camera)
        if not any(tensor.requires_grad for tensor in scene.tensors()):
            return shown
        carrier = gradient(scene, camera)
        return carrier + (shown - carrier).detach()

    return rendered
