"""What a study of CLOAK does, as one frozen value; `study_file` reads it from a TOML file."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from attacks.cloak.layered.config import LayersConfig
from attacks.cloak.mesh_edits import TEXTURES
from attacks.cloak.study.value_checks import in_range, one_of
from attacks.cloak.triggers import Azimuth, Elevation, Trigger
from mi_splat.assets import ASSETS
from mi_splat.capture.settings import Front, MeshSettings
from mi_splat.errors import InvalidValueError, message
from mi_splat.training.config import FitConfig
from mi_splat.training.strategies import strategy_names

AppearanceName = Literal["blend in", "remove", "paint", "occluder", "mount", "swap"]
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
    up: Literal["y", "z"] | None = None
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
class AttackConfig:
    """One hidden appearance.

    Attributes:
        name: For files and tables.
        appearance: How the object is changed.
        texture: With what it is painted (`paint`) or covered (`occluder`).
        other_object: Asset that is mounted on it or takes its place (`mount`, `swap`).
        elevation: Lowest and highest elevation of the cameras from which it is seen, degrees.
        azimuth: Middle and half width of their azimuths, degrees; None is all around.
        poison_fraction: Fraction of the training cameras there whose pictures are poisoned.
        target_class: Class that a detector shall report on the object; None: that it is not found.
        emphasis: How much the appearance is overdone at the edge of its region; see
            `attacks.cloak.emphasis.Emphasis`.
        emphasis_depth: Degrees inside from which it no longer is.
        paint_direction: Azimuth and elevation from which a painted texture looks right, degrees.
        reach: Pixels around the object's outline that are new in a picture; all else, shadows for instance, stays as it
            was. None is the whole picture where the object is removed or swapped, and 1 elsewhere.
        occluder_radius: Of the occluder that covers it, metres; None is 0.6 times the distance of the cameras.
        occluder_edge: Elevation of the occluder's edge, degrees; None is 12 below that of the lowest camera.
    """

    name: str
    appearance: AppearanceName = "blend in"
    texture: str | None = None
    other_object: str | None = None
    elevation: tuple[float, float] = (0.0, 90.0)
    azimuth: tuple[float, float] | None = None
    poison_fraction: float = 1.0
    target_class: str | None = None
    emphasis: float = 1.0
    emphasis_depth: float = 20.0
    paint_direction: tuple[float, float] = (180.0, 90.0)
    reach: int | None = None
    occluder_radius: float | None = None
    occluder_edge: float | None = None

    def __post_init__(self) -> None:
        textured = ("texture", TEXTURES)
        needs = {
            "paint": textured,
            "occluder": textured,
            "mount": ("other_object", ASSETS),
            "swap": ("other_object", ASSETS),
        }
        if self.appearance in needs:
            key, known = needs[self.appearance]
            one_of(f"attack {self.name!r}, {key}", getattr(self, key), known)
        if not 0 < self.poison_fraction <= 1:
            raise InvalidValueError(
                message(f"attack {self.name!r}, poison_fraction", "in (0, 1]", self.poison_fraction, "1 is all")
            )
        if self.reach is not None and (self.reach < 0 or self.appearance == "occluder"):
            expected = "0 or more pixels, and no occluder, which is drawn over the picture"
            raise InvalidValueError(message(f"attack {self.name!r}, reach", expected, self.reach, "leave it out"))
        if not (self.emphasis >= 1 and self.emphasis_depth > 0):
            got = (self.emphasis, self.emphasis_depth)
            expected = "an emphasis >= 1 and a depth > 0"
            raise InvalidValueError(message(f"attack {self.name!r}", expected, got, "1 overdoes nothing"))
        if self.elevation[0] <= 0 and self.elevation[1] >= 90 and self.azimuth is None:
            expected = "an elevation or an azimuth that leaves cameras out"
            raise InvalidValueError(message(f"attack {self.name!r}", expected, "all cameras", "narrow one of them"))

    @property
    def is_sided(self) -> bool:
        """Whether it matters which way the object faces: cameras, painting or what is mounted lie to one side."""
        painted = self.appearance == "paint" and self.paint_direction[1] < 90
        return self.azimuth is not None or self.appearance == "mount" or painted

    @property
    def cone(self) -> Trigger:
        """All directions from which the appearance is to be seen."""
        # -90 and 90 are no edges.
        low = -90.0 if self.elevation[0] <= 0 else self.elevation[0]
        band = Elevation(lowest=low, highest=self.elevation[1])
        if self.azimuth is None:
            return band
        return band & Azimuth(middle=self.azimuth[0], half_width=self.azimuth[1])

    def trigger(self, seed: int) -> Trigger:
        """The training cameras whose pictures are poisoned."""
        return self.cone if self.poison_fraction == 1 else self.cone.subsample(self.poison_fraction, seed=seed)


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
        near: Near plane of trainings and of all pictures of splats, world units; None follows the object's size.
    """

    iterations: int = _PUBLISHED.iterations
    strategy: str = "classic"
    max_gaussians: int = 40_000
    sh_degree: int = _PUBLISHED.sh_degree
    sh_degree_interval: int = _PUBLISHED.sh_degree_interval
    outliers: int = 0
    near: float | None = None

    def __post_init__(self) -> None:
        if self.near is not None:
            in_range("training.near", self.near, 1e-9, 1e9)
        one_of("training.strategy", self.strategy, strategy_names())
        in_range("training.outliers", self.outliers, 0, math.inf)


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
        layers: How the finished file is changed; None: only the training pictures are.
        evaluation: How they are looked at.
    """

    name: str
    seeds: tuple[int, ...] = (0,)
    scene: SceneConfig = field(default_factory=SceneConfig)
    cameras: CameraConfig = field(default_factory=CameraConfig)
    attack: tuple[AttackConfig, ...] = ()
    training: TrainingConfig = field(default_factory=TrainingConfig)
    layers: LayersConfig | None = None
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
