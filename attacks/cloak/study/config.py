"""What a study of CLOAK does, as one frozen value; `study_file` reads it from a TOML file."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from attacks.cloak.cleaning import CleaningConfig
from attacks.cloak.layered.config import LayersConfig
from attacks.cloak.study.attack_config import AttackConfig, SurrogateConfig
from attacks.cloak.study.value_checks import in_range, one_of
from mi_splat.assets import ASSETS
from mi_splat.capture.settings import Front, MeshSettings, Up
from mi_splat.errors import InvalidValueError, message
from mi_splat.training.config import FitConfig
from mi_splat.training.strategies import strategy_names

Colour = tuple[float, float, float]

_PUBLISHED = FitConfig()


@dataclass(frozen=True, slots=True, kw_only=True)
class SceneConfig:
    """What is photographed: an object on a square of ground in daylight, in front of one colour.

    Attributes:
        object: One of the project's assets, or the path of a mesh file.
        label: What detectors call it; None is the name of the asset.
        seed: Which asset of that name.
        ground: Texture of the ground.
        ground_size: Side of the ground, metres.
        sun_azimuth: Degrees from +x towards +y.
        sun_elevation: Degrees.
        background: sRGB colour in the place of the sky, which the splat is trained with, too.
        up: Axis that points up in a mesh file; None is y for OBJ and glTF and z for PLY.
        scale: What one unit of a mesh file is in metres.
        rotate: Degrees by which a mesh file is turned about x, then y, then z, after `up`.
        front: Which way a mesh file's object faces after that; it is turned to face +x. Attacks from one side need it.
    """

    object: str = "car"
    label: str | None = None
    seed: int = 900004
    ground: Literal["road", "grass"] = "road"
    ground_size: float = 16.0
    sun_azimuth: float = -50.0
    sun_elevation: float = 52.0
    background: Colour = (0.55, 0.7, 0.9)
    up: Up | None = None
    scale: float = 1.0
    rotate: tuple[float, float, float] = (0.0, 0.0, 0.0)
    front: Front | None = None

    def __post_init__(self) -> None:
        if self.object not in ASSETS and not Path(self.object).is_file():
            expected = f"{', '.join(ASSETS)}, or the path of a mesh file"
            raise InvalidValueError(message("scene.object", expected, repr(self.object), "name one of these"))
        if self.object not in ASSETS and self.label is None:
            raise InvalidValueError(message("scene.label", "what detectors call the object", "nothing", "say it"))
        _ = self.mesh

    @property
    def mesh(self) -> MeshSettings:
        """How a mesh file is read and turned."""
        return MeshSettings(up=self.up, scale=self.scale, rotate=self.rotate, front=self.front)

    @property
    def has_front(self) -> bool:
        """Whether it is known that the object faces +x."""
        return self.object in ASSETS or self.front is not None

    @property
    def class_name(self) -> str:
        """What detectors call the object."""
        return self.label or self.object


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraConfig:
    """Where pictures are taken from: a Fibonacci hemisphere around the object.

    Attributes:
        train: Number of training pictures.
        distance: Metres from the centre; None is as near as shows the whole object.
        height: Height of the centre above the ground, metres.
        fov: Field of view, degrees.
        size: Width and height, pixels.
        samples: Samples per pixel.
        points: Points of the cloud that trainings start from.
    """

    train: int = 210
    distance: float | None = None
    height: float = 0.7
    fov: float = 45.0
    size: int = 256
    samples: int = 32
    points: int = 20_000

    def __post_init__(self) -> None:
        for name in ("train", "size", "samples", "points"):
            in_range(f"cameras.{name}", getattr(self, name), 1, math.inf)
        in_range("cameras.fov", self.fov, 1.0, 179.0)
        if self.distance is not None:
            in_range("cameras.distance", self.distance, 1e-6, math.inf)


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainingConfig:
    """How both splats are trained; the victim's choice, of which the attack knows nothing.

    Attributes:
        iterations: Steps.
        strategy: As in `mi-splat train`.
        max_gaussians: Largest number of Gaussians.
        sh_degree: SH degree.
        sh_degree_interval: Steps between two raises of the degree that is trained; 0 trains all of it from the start.
        outliers: Points in the air that the cloud has besides those on surfaces; see
            `mi_splat.training.initialization.with_outliers`.
        point_deviations: The victim removes outliers from the cloud before the training, of so many standard
            deviations; see `attacks.cloak.cleaning.inliers`. None keeps all points.
        near: Near plane of trainings and of all pictures of splats, world units; None follows the object's size.
    """

    iterations: int = _PUBLISHED.iterations
    strategy: str = "classic"
    max_gaussians: int = 40_000
    sh_degree: int = _PUBLISHED.sh_degree
    sh_degree_interval: int = _PUBLISHED.sh_degree_interval
    outliers: int = 0
    point_deviations: float | None = None
    near: float | None = None

    def __post_init__(self) -> None:
        if self.near is not None:
            in_range("training.near", self.near, 1e-9, 1e9)
        one_of("training.strategy", self.strategy, strategy_names())
        in_range("training.outliers", self.outliers, 0, math.inf)
        if self.point_deviations is not None:
            in_range("training.point_deviations", self.point_deviations, 0, math.inf)


@dataclass(frozen=True, slots=True, kw_only=True)
class EvaluationConfig:
    """How both splats are looked at afterwards, from cameras that no training used.

    Attributes:
        detectors: Names of detectors.
        cameras: Held-out cameras on the hemisphere, before those within `min_separation` of a training camera are
            dropped.
        min_separation: Least angle to the nearest training camera, degrees.
        confidence: Score from which a detection counts.
        well_inside: Degrees inside a trigger from which a camera lies well inside.
        far_outside: Degrees outside of all triggers from which pictures are compared with the true ones.
        reference_views: Number of such pictures.
        meridians: Meridians along which the transition is measured.
        meridian_step: Degrees between two pictures of an arc.
    """

    detectors: tuple[str, ...] = ("fasterrcnn_small",)
    cameras: int = 430
    min_separation: float = 1.0
    confidence: float = 0.5
    well_inside: float = 5.0
    far_outside: float = 15.0
    reference_views: int = 40
    meridians: int = 3
    meridian_step: float = 2.5

    def __post_init__(self) -> None:
        if not self.detectors or len(set(self.detectors)) != len(self.detectors):
            expected = "one or more, each once"
            raise InvalidValueError(message("evaluation.detectors", expected, self.detectors, "name a detector"))
        in_range("evaluation.cameras", self.cameras, 1, math.inf)
        in_range("evaluation.confidence", self.confidence, 0.0, 1.0)
        in_range("evaluation.meridian_step", self.meridian_step, 0.1, 45.0)
        for name in ("min_separation", "well_inside", "far_outside", "reference_views", "meridians"):
            in_range(f"evaluation.{name}", getattr(self, name), 0, math.inf)


@dataclass(frozen=True, slots=True, kw_only=True)
class StudyConfig:
    """A study of CLOAK.

    Attributes:
        name: Of the study.
        seeds: One clean and one cloaked training for each.
        scene: What is photographed.
        cameras: Where from.
        attack: The hidden appearances; no camera may belong to two.
        training: How splats are trained.
        surrogate: How the attacker corrects the poison by trainings of his own; None: it is not corrected.
        layers: How the finished file is changed; None: only the training pictures are.
        cleaning: What the victim does to both finished splats before they are looked at; None: nothing.
        evaluation: How they are looked at.
    """

    name: str
    seeds: tuple[int, ...] = (0,)
    scene: SceneConfig = field(default_factory=SceneConfig)
    cameras: CameraConfig = field(default_factory=CameraConfig)
    attack: tuple[AttackConfig, ...] = ()
    training: TrainingConfig = field(default_factory=TrainingConfig)
    surrogate: SurrogateConfig | None = None
    layers: LayersConfig | None = None
    cleaning: CleaningConfig | None = None
    evaluation: EvaluationConfig = field(default_factory=EvaluationConfig)

    def __post_init__(self) -> None:
        if not self.attack or not self.seeds:
            raise InvalidValueError(message("study", "an attack and a seed", "none", "add [[attack]] or seeds"))
        if len(set(self.seeds)) != len(self.seeds) or min(self.seeds) < 0:
            raise InvalidValueError(message("seeds", "numbers >= 0, each once", self.seeds, "change them"))
        names = [attack.name for attack in self.attack]
        if len(set(names)) != len(names):
            raise InvalidValueError(message("attacks", "different names", names, "rename one"))
        if self.layers is not None and not (self.layers.attacks and set(self.layers.attacks) <= set(names)):
            expected = f"some of {', '.join(names)}"
            raise InvalidValueError(
                message("layers.attacks", expected, self.layers.attacks, "name attacks of the study")
            )
        sided = [attack.name for attack in self.attack if attack.is_sided]
        if sided and not self.scene.has_front:
            expected = f"which way the mesh faces, as attack {sided[0]!r} has a side of it"
            do = 'add front = "+x", "-x", "+y" or "-y" (after up and rotate) under [scene]'
            raise InvalidValueError(message("scene.front", expected, "nothing", do))
