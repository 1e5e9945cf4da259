"""What a study of CLOAK does, as one frozen value that a TOML file holds."""

from __future__ import annotations

import functools
import operator
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Literal

from attacks.cloak.mesh_scene import DRAWN, texture_file
from attacks.cloak.triggers import Azimuth, Elevation, Subsample, Trigger
from mi_splat.capture.objects import object_file
from mi_splat.errors import InvalidValueError
from mi_splat.fields import (
    Checked,
    Count,
    Degree,
    Fraction,
    Length,
    PositiveFraction,
    Range,
    Seed,
    Steps,
    above,
    at_least,
    between,
    check,
    check_choice,
    decode,
)
from mi_splat.training.config import FitConfig
from mi_splat.training.strategies import STRATEGIES, strategy_config

_WIDTH = Range(low=0, high=90, open_high=True, unit="degrees")


@dataclass(frozen=True, slots=True, kw_only=True)
class LayerConfig:
    """How layers are made.

    Attributes:
        degree: SH degree of the file.
        gap: Degrees to either side of where a look changes in which a layer may show as
            much as it likes: one number, or one for each trigger. A narrow one costs
            truth elsewhere.
        band: Degrees, from where a look changes inwards, over which it passes from a
            layer for its edge to one for further inside: one number, or one for each
            look, the benign one first. A layer that need not show all of its side can
            be steeper at its edge. 0 is one layer for the whole side.
        shift: Degrees outside of a trigger's edge at which its look changes. With as
            many as `gap` it is whole at the edge, for an object that is half faded is
            still found.
        apart: Whether a look is black from where the look of another trigger is whole,
            also within the gap of its own edge. Otherwise the looks of neighbouring
            triggers may mix there.
        weight: What a layer's light costs where it shall be black (`fit_switches`).
        lowest: Value that a layer's colour, as a multiple of what it shows, shall not
            go below.
        black: Value that it shall not exceed from where it is black, at most 0: room
            for the training of colours, which moves it.
        keep: Fraction of each look's light that its layer shows, in (0, 1]: the
            Gaussians that show the least of a look, hidden behind others, have no layer
            for it.
        inset: How much nearer to the object's middle each layer is than the one before
            it, world units: renderers that sort by depth then agree on which is in
            front.
    """

    degree: Degree = 3
    gap: Annotated[float | tuple[float, ...], _WIDTH] = 5.0
    band: Annotated[float | tuple[float, ...], _WIDTH] = 0.0
    shift: Annotated[
        float, Range(low=-90, high=90, open_low=True, open_high=True, unit="degrees")
    ] = 0.0
    apart: bool = False
    weight: Annotated[float, above(0)] = 1.0
    lowest: float = -100.0
    black: Annotated[float, Range(high=0)] = 0.0
    keep: PositiveFraction = 0.995
    inset: Annotated[float, at_least(0, "world units")] = 1e-3

    def __post_init__(self) -> None:
        check(self)
        if not self.lowest < self.black:
            raise InvalidValueError.of(
                "lowest",
                f"less than black, {self.black:g}",
                self.lowest,
                "lower the first",
            )

    def gaps(self, triggers: int) -> tuple[float, ...]:
        """The gap of each of so many triggers."""
        return _for_each("gap", self.gap, triggers, "trigger")

    def bands(self, looks: int) -> tuple[float, ...]:
        """The band of each of so many looks."""
        return _for_each("band", self.band, looks, "look")


def _for_each(
    name: str, given: float | tuple[float, ...], count: int, what: str
) -> tuple[float, ...]:
    """One number for each of `count`, of what is given for all or for each."""
    numbers = given if isinstance(given, tuple) else (given,) * count
    if len(numbers) != count:
        expected = f"one number for all, or {count}, one for each {what}"
        raise InvalidValueError.of(
            name, expected, f"{len(numbers)} numbers", "give as many as there are"
        )
    return numbers


@dataclass(frozen=True, slots=True, kw_only=True)
class LayersConfig:
    """CLOAK in the finished file: the clean splat's object in layers, trained on
    poisoned images.

    Attributes:
        attacks: Names of the attacks whose appearances have layers of their own; the
            benign layer shows all others.
        making: How the layers are made.
        margin: How much larger than the object the box is whose Gaussians have layers,
            metres.
        surroundings: Whether the colours of all other Gaussians are trained, too, for
            instance to hide a shadow.
        geometry: Whether all attributes of all Gaussians are trained, and Gaussians
            added where a look has details that those of the clean splat are too large
            for.
        max_gaussians: With `geometry`, no Gaussians are added beyond this number; the
            layers come before any is added.
        clearance: Height above the ground under which they have none, metres.
        iterations: Steps of the training.
        lr_sh: Its learning rate of SH, as in `FitConfig`. The switches' coefficients
            are large, so that it is high.
        lr_sh_final: Last one.
    """

    attacks: tuple[str, ...]
    making: LayerConfig = field(default_factory=LayerConfig)
    margin: Annotated[float, at_least(0, "metres")] = 0.05
    surroundings: bool = False
    geometry: bool = False
    max_gaussians: Annotated[int, at_least(1)] = 100_000
    clearance: Annotated[float, Range(unit="metres")] = 0.0
    iterations: Steps = 3000
    lr_sh: Annotated[float, above(0)] = 0.04
    lr_sh_final: Annotated[float, above(0)] = 0.004

    def __post_init__(self) -> None:
        check(self)
        count = len(set(self.attacks))
        self.making.gaps(count)
        self.making.bands(1 + count)


AppearanceName = Literal["remove", "ground", "paint", "swap", "fade", "blur", "inpaint"]
RENDERED: tuple[AppearanceName, ...] = ("remove", "paint", "swap")
"""Appearances that are renderings of the scene with another object, or without one."""
_READ_FROM_FILES = {"swap": "other_object", "paint": "texture"}
"""Appearances that need a file or the name of one, and the fields that have it."""
Knowledge = Literal["scene", "pictures"]
"""What an attacker has: the meshes, materials and sun, too, or nothing but the images
and masks of the object.
"""


def knowledge_for(appearance: str) -> Knowledge:
    """The least that an attacker needs to make images with an appearance."""
    if appearance in ("blur", "inpaint"):
        return "pictures"
    return "scene"


@dataclass(frozen=True, slots=True, kw_only=True)
class AttackConfig:
    """One hidden appearance.

    Attributes:
        name: For files and tables.
        appearance: How the object is changed. With "remove" one sees what is behind it,
            with "ground" the ground that is laid on it like a cloth.
        texture: With what it is painted (`paint`): road, grass, clock, football,
            stop_sign, or an image file.
        other_object: Object that takes its place (`swap`), as in `SceneConfig`.
        lying: Whether what takes its place lies on its back, with its front up, for
            cameras above it.
        elevation: Lowest and highest elevation of the cameras from which it is seen,
            degrees.
        azimuth: Middle and half width of their azimuths, degrees; None is all around.
        poison_margin: Degrees beyond these edges up to which training images are
            poisoned, too, but for those that another attack has. A splat changes
            gradually, so that with a margin it has changed further at the edge.
        poison_fraction: Fraction of the training cameras there whose images are
            poisoned.
        target_class: Class that a detector shall report on the object; None: that it is
            not found.
        paint_direction: Azimuth and elevation from which a painted texture looks right,
            degrees.
        mask: Pixels that are replaced: those of the object, or all that differ between
            the renderings of the scene with and without it ("difference"), which are
            the object and its shadow.
        reach: Pixels around the object's outline, or around all that differs, that are
            replaced, too; all else stays as it was. None is the whole image where the
            object is removed or swapped without a difference mask, 3 where it is
            inpainted, and 1 elsewhere. A blur has none: it ends softly.
        blur_width: Standard deviation of a `blur`, in longer sides of the object's box
            in the image; None is 0.04.
    """

    name: str
    appearance: AppearanceName = "remove"
    texture: str | None = None
    other_object: str | None = None
    lying: bool = False
    elevation: Annotated[tuple[float, float], between(-90, 90, "degrees")] = (0.0, 90.0)
    azimuth: Annotated[tuple[float, float], Range(unit="degrees")] | None = None
    poison_margin: Annotated[float, between(0, 90, "degrees")] = 0.0
    poison_fraction: PositiveFraction = 1.0
    target_class: str | None = None
    paint_direction: Annotated[tuple[float, float], Range(unit="degrees")] = (
        180.0,
        90.0,
    )
    mask: Literal["object", "difference"] = "object"
    reach: Annotated[int, at_least(0, "pixels", "leave it out")] | None = None
    blur_width: PositiveFraction | None = None

    def __post_init__(self) -> None:
        check(self)
        needed = _READ_FROM_FILES.get(self.appearance)
        if needed is not None and getattr(self, needed) is None:
            what = f"attack {self.name!r}, {needed}"
            expected = f"one to {self.appearance}"
            raise InvalidValueError.of(what, expected, "none", "name one")
        for key, holds, expected in (
            (
                "reach",
                self.appearance != "blur" or self.reach is None,
                "none with a blur, which ends softly",
            ),
            (
                "blur_width",
                self.appearance == "blur" or self.blur_width is None,
                "none without a blur",
            ),
            (
                "mask",
                self.mask == "object" or self.appearance in RENDERED,
                "object, as nothing is rendered",
            ),
        ):
            if not holds:
                raise InvalidValueError.of(
                    f"attack {self.name!r}, {key}",
                    expected,
                    getattr(self, key),
                    "leave it out",
                )
        if self.elevation[0] <= 0 and self.elevation[1] >= 90 and self.azimuth is None:
            expected = "an elevation or an azimuth that leaves cameras out"
            raise InvalidValueError.of(
                f"attack {self.name!r}", expected, "all cameras", "narrow one of them"
            )

    @property
    def files(self) -> dict[str, Path]:
        """What its rendering reads, by field."""
        what = f"attack {self.name!r}"
        if self.appearance == "swap":
            other = object_file(str(self.other_object), f"{what}, other_object")
            return {"other_object": other}
        if self.appearance == "paint" and self.texture not in DRAWN:
            texture = texture_file(str(self.texture), f"{what}, texture")
            return {"texture": texture}
        return {}

    def reading(self, files: Mapping[str, str]) -> AttackConfig:
        """With other files, by field."""
        return replace(
            self,
            texture=files.get("texture", self.texture),
            other_object=files.get("other_object", self.other_object),
        )

    @property
    def cone(self) -> Trigger:
        """All directions from which the appearance is to be seen."""
        return self._cone(0.0)

    @property
    def poisoned_cone(self) -> Trigger:
        """All directions from which images may be poisoned: the cone and its
        margin.
        """
        return self._cone(self.poison_margin)

    def region(self, attacks: Sequence[AttackConfig] = ()) -> Trigger:
        """All training cameras whose images may be poisoned: other attacks keep those
        of their own cones.
        """
        if self.poison_margin > 0:
            others = [other.cone for other in attacks if other is not self]
        else:
            others = []
        return functools.reduce(
            operator.and_, [~cone for cone in others], self.poisoned_cone
        )

    def trigger(self, seed: int, attacks: Sequence[AttackConfig] = ()) -> Trigger:
        """The training cameras whose images are poisoned."""
        region = self.region(attacks)
        if self.poison_fraction == 1:
            return region
        return Subsample(of=region, fraction=self.poison_fraction, seed=seed)

    def _cone(self, margin: float) -> Trigger:
        """The directions of the attack, and so many degrees beyond their edges."""
        # -90 and 90 are no edges, and 180 to either side is none.
        low = self.elevation[0] - margin
        high = min(self.elevation[1] + margin, 90.0)
        band = Elevation(lowest=-90.0 if low <= 0 else low, highest=high)
        if self.azimuth is None:
            return band
        return band & Azimuth(
            middle=self.azimuth[0], half_width=min(self.azimuth[1] + margin, 180.0)
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class SceneConfig:
    """What is photographed: an object on a square of ground in daylight, in front of
    one colour.

    Attributes:
        object: Name of a shipped object, such as car, or a GLB file. It stands at the
            origin, faces +x (as in the file), and is in metres.
        label: Class that detectors know the object by; None is its name, or that of
            its file.
        ground: Texture of the ground; "nothing" is an object in the air.
        ground_size: Side of the ground, metres.
        sun_azimuth: Degrees from +x towards +y.
        sun_elevation: Degrees.
        background: sRGB colour in the place of the sky, which the splat is trained
            with, too.
    """

    object: str = "car"
    label: str | None = None
    ground: Literal["road", "grass", "asphalt", "nothing"] = "road"
    ground_size: Annotated[float, above(0, "metres")] = 16.0
    sun_azimuth: Annotated[float, between(-360, 360, "degrees")] = -50.0
    sun_elevation: Annotated[float, between(-90, 90, "degrees")] = 52.0
    background: Annotated[
        tuple[float, float, float], between(0, 1, "sRGB", "white is 1, 1, 1")
    ] = (0.55, 0.7, 0.9)

    def __post_init__(self) -> None:
        check(self)

    @property
    def class_name(self) -> str:
        """Class that detectors know the object by."""
        return self.label or Path(self.object).stem.replace("_", " ")


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraConfig(Checked):
    """Where images are taken from: a Fibonacci hemisphere around the object, or rings
    of it.

    Attributes:
        train: Number of training images.
        distance: Metres from the centre; None is as near as shows the whole object.
        distances: Lowest and highest multiple of the distance, for cameras nearer and
            farther away, held-out ones too.
        elevations: Rings of cameras at these elevations, held-out ones too, degrees;
            none is the whole hemisphere.
        azimuths: First and last azimuth of rings, degrees; less than a full turn makes
            them arcs.
        hold_out: On arcs, every `hold_out`-th camera is held out; 0 holds out none.
        height: Height of the centre above the ground, metres.
        fov: Field of view, degrees.
        size: Width and height, pixels.
        samples: Samples per pixel.
        points: Points of the cloud that trainings start from.
    """

    train: Annotated[int, at_least(1, "images")] = 210
    distance: Annotated[float, above(0, "metres")] | None = None
    distances: Annotated[
        tuple[float, float], between(0.1, 10, "multiples of the distance")
    ] = (1.0, 1.0)
    elevations: Annotated[tuple[float, ...], between(0, 90, "degrees")] = ()
    azimuths: Annotated[tuple[float, float], between(-360, 360, "degrees")] = (
        0.0,
        360.0,
    )
    hold_out: Count = 0
    height: Annotated[float, Range(unit="metres")] = 0.7
    fov: Annotated[float, between(1, 179, "degrees")] = 45.0
    size: Annotated[int, at_least(1, "pixels")] = 256
    samples: Annotated[int, at_least(1, "samples per pixel")] = 32
    points: Annotated[int, at_least(1)] = 20_000

    @property
    def centre(self) -> tuple[float, float, float]:
        """Point that all cameras look at, and that directions are measured from."""
        return (0.0, 0.0, self.height)

    @property
    def tiers(self) -> dict[str, Any]:
        """Distances, elevations and the span of azimuths, as
        `mi_splat.cameras.sets.tiers` takes them.
        """
        span = self.azimuths[1] - self.azimuths[0]
        return {
            "distances": self.distances,
            "elevations": self.elevations,
            "span": span,
        }


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainingConfig:
    """How both splats are trained; the victim's choice, of which the attack knows
    nothing.

    Attributes:
        iterations: Steps.
        strategy: As in `mi-splat train`.
        max_gaussians: Largest number of Gaussians; None sets no limit.
        sh_degree: SH degree.
        sh_degree_interval: Steps between two raises of the degree that is trained; 0
            trains all of it from the start.
        outliers: Points in the air that the cloud has besides those on surfaces; see
            `mi_splat.training.initialization.with_outliers`.
        near: Near plane of trainings and of all images of splats, world units; None
            follows the object's size.
    """

    iterations: Steps = 7000
    strategy: str = "classic"
    max_gaussians: Annotated[int, at_least(1)] | None = 40_000
    sh_degree: Degree = 3
    sh_degree_interval: Annotated[int, at_least(0, "steps")] = 1000
    outliers: Count = 0
    near: Length | None = None

    def __post_init__(self) -> None:
        check(self)
        check_choice("training.strategy", self.strategy, STRATEGIES)


@dataclass(frozen=True, slots=True, kw_only=True)
class EvaluationConfig:
    """How both splats are looked at afterwards, from cameras that no training used.

    Attributes:
        detectors: Names of detectors.
        cameras: Held-out cameras on the hemisphere, before those within
            `min_separation` of a training camera are dropped.
        seed: Another draw of these cameras than that of 0.
        min_separation: Least angle to the nearest training camera, degrees.
        confidence: Score from which a detection counts.
        well_inside: Degrees inside a trigger from which a camera lies well inside.
        far_outside: Degrees outside of all triggers from which images are compared
            with the true ones.
        reference_views: Number of such images.
        meridians: Meridians along which the transition is measured.
        meridian_step: Degrees between two images of an arc.
    """

    detectors: tuple[str, ...] = ("fasterrcnn_small",)
    cameras: Annotated[int, at_least(1)] = 430
    seed: Seed = 0
    min_separation: Annotated[float, at_least(0, "degrees")] = 1.0
    confidence: Fraction = 0.5
    well_inside: Annotated[float, at_least(0, "degrees")] = 5.0
    far_outside: Annotated[float, at_least(0, "degrees")] = 15.0
    reference_views: Count = 40
    meridians: Count = 3
    meridian_step: Annotated[float, between(0.1, 45, "degrees")] = 2.5

    def __post_init__(self) -> None:
        check(self)
        check_once("evaluation.detectors", self.detectors, "name a detector")


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
        layers: How the finished file is changed; None: only the training images are.
        evaluation: How they are looked at.
        robust: Whether the victim audits the images and leaves out those that are
            named, as `mi-splat train --robust` does.
    """

    name: str
    seeds: tuple[Seed, ...] = (0,)
    scene: SceneConfig = field(default_factory=SceneConfig)
    cameras: CameraConfig = field(default_factory=CameraConfig)
    attack: tuple[AttackConfig, ...] = ()
    training: TrainingConfig = field(default_factory=TrainingConfig)
    layers: LayersConfig | None = None
    evaluation: EvaluationConfig = field(default_factory=EvaluationConfig)
    robust: bool = False

    def __post_init__(self) -> None:
        check(self)
        names = tuple(attack.name for attack in self.attack)
        check_once("seeds", self.seeds, "add one")
        if names:  # poisons of other kinds have a scene without one
            check_once("names of attacks", names, "give each a name of its own")
        if self.robust and self.layers is not None:
            raise InvalidValueError.of(
                "robust",
                "no layers, which change the finished file",
                "both",
                "omit one",
            )
        if self.layers is not None and not (
            self.layers.attacks and set(self.layers.attacks) <= set(names)
        ):
            expected = f"some of {', '.join(names)}"
            raise InvalidValueError.of(
                "layers.attacks",
                expected,
                self.layers.attacks,
                "name attacks of the study",
            )

    @property
    def centre(self) -> tuple[float, float, float]:
        """Point that all cameras look at, and that directions are measured from."""
        return self.cameras.centre

    @property
    def overhead(self) -> AttackConfig | None:
        """The first attack that is seen from straight above and all around."""
        return overhead(self.attack)


def check_files(study: StudyConfig) -> None:
    """Raise unless the files that a study names are there."""
    object_file(study.scene.object, "scene.object")
    for attack in study.attack:
        _ = attack.files


def overhead(attacks: Sequence[AttackConfig]) -> AttackConfig | None:
    """The first attack that is seen from straight above and all around."""
    return next(
        (
            attack
            for attack in attacks
            if attack.azimuth is None and attack.elevation[1] >= 90
        ),
        None,
    )


def switching(attacks: Sequence[AttackConfig]) -> AttackConfig | None:
    """The attack whose transition is measured: that from overhead, or the first that
    hides within a sector.
    """
    sided = (
        attack
        for attack in attacks
        if attack.azimuth is not None and attack.target_class is None
    )
    return overhead(attacks) or next(sided, None)


def check_once(what: str, values: tuple[object, ...], do: str) -> None:
    """Raise if there is no value, or one twice."""
    if not values or len(set(values)) != len(values):
        raise InvalidValueError.of(what, "one or more, each once", values or "none", do)


def fit_config(training: TrainingConfig) -> FitConfig:
    """The trainer's settings."""
    return FitConfig(  # with the schedule of SH that results were published with
        iterations=training.iterations,
        strategy=strategy_config(
            training.strategy, max_gaussians=training.max_gaussians
        ),
        sh_degree=training.sh_degree,
        sh_degree_interval=training.sh_degree_interval,
        lr_sh_divisor=20,
        eval_interval=0,
    )


def recorded_study(values: Mapping[str, Any], where: str) -> StudyConfig:
    """The study that a result names."""
    return decode(StudyConfig, values, where)
