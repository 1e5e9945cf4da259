"""What pictures are made and how a detector is trained on them, as values; light, so that --help is fast."""

from __future__ import annotations

from dataclasses import dataclass

from attacks.detectors.catalogue import SMALL_CLASSES, SMALL_SIDE
from mi_splat.errors import InvalidValueError, message

SPLITS = {"train": (0, 100_000), "validation": (300_000, 400_000), "held-out": (500_000, 600_000)}
"""Half-open ranges of asset seeds; also what separates the splits' cameras, lights and surroundings."""

BACKGROUNDS = ("street", "park", "room", "ground", "random")
"""Kinds of pictures without any object: the project's own surroundings, and random grounds, walls and clutter."""


def check_kind(kind: str) -> None:
    """Raise unless a kind of surroundings is one of `BACKGROUNDS`.

    Raises:
        InvalidValueError: It is none.
    """
    if kind not in BACKGROUNDS:
        raise InvalidValueError(message("kind", " or ".join(BACKGROUNDS), repr(kind), "choose one of them"))


def _check_split(split: str) -> None:
    if split not in SPLITS:
        raise InvalidValueError(message("split", " or ".join(SPLITS), repr(split), "choose one of them"))


@dataclass(frozen=True, slots=True, kw_only=True)
class PictureSetConfig:
    """What a data set is made of.

    Attributes:
        split: Key of `SPLITS`.
        count: Number of pictures.
        seed: Seed of everything that is random.
        size: Width and height, pixels.
        shots: Pictures of each scene.
        samples: Samples per pixel.
        empty: Fraction of scenes without any object.
        pair: Fraction of scenes with two objects.
        street: Fraction of scenes in the surroundings of `mi_splat.assets.street.backdrop`: park, open ground, room.
            Its streets need less room around the origin than is asked for here; `around` shows them.
        least_visible: Objects of which less than this fraction can be seen are not labelled.
        elevation: Lowest and highest elevation of the cameras, degrees.
        focus: Classes that take turns as a scene's first object; one may come several times.
        around: Kind in `BACKGROUNDS` of every scene's surroundings; None draws them as `street` says.
        farthest: Longest distance of a camera from what it looks at, metres, but for what it would not show whole; None
            is any distance. Between the houses of a street, a camera farther away sees a wall.
    """

    split: str = "train"
    count: int = 2800
    seed: int = 0
    size: int = SMALL_SIDE
    shots: int = 3
    samples: int = 6
    empty: float = 0.06
    pair: float = 0.3
    street: float = 0.5
    least_visible: float = 0.15
    elevation: tuple[float, float] = (0.0, 90.0)
    focus: tuple[str, ...] = SMALL_CLASSES
    around: str | None = None
    farthest: float | None = None

    def __post_init__(self) -> None:
        _check_split(self.split)
        if self.around is not None:
            check_kind(self.around)


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainingSetConfig:
    """How many pictures of each kind a detector is trained on.

    Attributes:
        pictures: Path-traced ones of all kinds.
        surroundings: Further ones in the surroundings of `mi_splat.assets.street.backdrop`, many without any object.
        overhead: Further ones from above, of cars and trains more than of others.
        streets: Further ones in streets, from at most 9 metres.
        splats: Further scenes that are made into splats, eight renders of each.
        street_splats: As many more in streets.
        backgrounds: Scenes without any object of each kind in `BACKGROUNDS`, six pictures each; twice as many streets
            more, and as many again in three pictures each of more samples per pixel.
        validation: Pictures with objects by which the best epoch is chosen.
        validation_backgrounds: Scenes of each kind without any object, two pictures each, by which it is chosen too.
    """

    pictures: int = 3600
    surroundings: int = 720
    overhead: int = 720
    streets: int = 600
    splats: int = 40
    street_splats: int = 16
    backgrounds: int = 24
    validation: int = 120
    validation_backgrounds: int = 12


@dataclass(frozen=True, slots=True, kw_only=True)
class BackgroundConfig:
    """Pictures without any object, on which every detection is a false positive.

    Attributes:
        scenes: Scenes of each kind in `BACKGROUNDS`.
        shots: Pictures of each scene.
        samples: Samples per pixel.
        size: Width and height, pixels.
        split: Key of `SPLITS`.
        seed: Seed of everything that is random.
    """

    scenes: int = 12
    shots: int = 2
    samples: int = 24
    size: int = SMALL_SIDE
    split: str = "held-out"
    seed: int = 0

    def __post_init__(self) -> None:
        _check_split(self.split)


@dataclass(frozen=True, slots=True, kw_only=True)
class SplatConfig:
    """How a splat is made of a scene, and how many pictures are taken of it.

    Attributes:
        views: Path-traced pictures that the splat is fitted to.
        samples: Samples per pixel in them.
        objects: Gaussians for each object.
        surroundings: Gaussians for all around it.
        sky: Gaussians for the sky.
        steps: Steps of refinement; 0 leaves the discs as they are laid.
        pictures: Renders of each splat, from cameras that none of the views used.
    """

    views: int = 16
    samples: int = 12
    objects: int = 12_000
    surroundings: int = 30_000
    sky: int = 1_500
    steps: int = 100
    pictures: int = 4


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainConfig:
    """How the detector is trained.

    Attributes:
        pretraining: Steps of classifying cut-outs before the first epoch.
        epochs: Passes over the pictures.
        batch: Pictures a step.
        learning_rate: Highest one of AdamW, reached after the warm-up and then lowered along a cosine.
        warm_up: Fraction of the steps over which the learning rate rises.
        weight_decay: Of AdamW.
        ema_decay: How much of the averaged weights (an exponential moving average) each step keeps.
        max_gradient_norm: Longer gradients are scaled down to it.
        mixed_precision: Convolutions and matrix products in bfloat16.
        low_resolution: Shorter image side in the first epochs, pixels; they are cheaper for it.
        low_resolution_fraction: Fraction of the epochs at that size.
        final_fraction: Fraction of the epochs, the last ones, whose training examples are closer to what the network
            meets in use; what that means, the trainer of the detector says.
        seed: Seed of the weights, of the order and of every random change of the pictures.
    """

    pretraining: int = 1000
    epochs: int = 20
    batch: int = 8
    learning_rate: float = 1.2e-3
    warm_up: float = 0.06
    weight_decay: float = 0.02
    ema_decay: float = 0.998
    max_gradient_norm: float = 5.0
    mixed_precision: bool = True
    low_resolution: int = 160
    low_resolution_fraction: float = 0.4
    final_fraction: float = 0.2
    seed: int = 0
