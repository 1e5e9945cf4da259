"""What pictures are made and how a detector is trained on them, as values; light, so that --help is fast."""

from dataclasses import dataclass
from typing import Annotated

from attacks.detectors.catalogue import SMALL_CLASSES, SMALL_SIDE
from mi_splat.fields import Called, Checked, Count, Fraction, Seed, Share, above, at_least, between, check, check_choice

SPLITS = {"train": (0, 100_000), "validation": (300_000, 400_000), "held-out": (500_000, 600_000)}
"""Half-open ranges of asset seeds; also what separates the splits' cameras, lights and surroundings."""

BACKGROUNDS = ("street", "park", "room", "ground", "random")
"""Kinds of pictures without any object: the project's own surroundings, and random grounds, walls and clutter."""

PATH_TRACED, SPLAT_RENDERS, EMPTY = "path traced", "splat renders", "background: "
"""Names of the held-out sets; that of a set without objects goes on with its kind in `BACKGROUNDS`."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PictureSetConfig:
    """What a data set is made of.

    Attributes:
        split: Key of `SPLITS`.
        count: Number of pictures; those that are left of the last scene come on top.
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
    count: Count = 2800
    seed: Seed = 0
    size: Annotated[int, at_least(1, "pixels")] = SMALL_SIDE
    shots: Annotated[int, at_least(1)] = 3
    samples: Annotated[int, at_least(1)] = 6
    empty: Fraction = 0.06
    pair: Fraction = 0.3
    street: Fraction = 0.5
    least_visible: Fraction = 0.15
    elevation: Annotated[tuple[float, float], between(-90, 90, "degrees"), Called("LEAST MOST")] = (0.0, 90.0)
    focus: tuple[str, ...] = SMALL_CLASSES
    around: str | None = None
    farthest: Annotated[float, above(0, "metres")] | None = None

    def __post_init__(self) -> None:
        check(self)
        check_choice("split", self.split, SPLITS)
        if self.around is not None:
            check_choice("around", self.around, BACKGROUNDS)


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainingSetConfig(Checked):
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

    pictures: Count = 3600
    surroundings: Count = 720
    overhead: Count = 720
    streets: Count = 600
    splats: Count = 40
    street_splats: Count = 16
    backgrounds: Count = 24
    validation: Annotated[int, at_least(1)] = 120
    validation_backgrounds: Count = 12


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

    scenes: Count = 12
    shots: Annotated[int, at_least(1)] = 2
    samples: Annotated[int, at_least(1)] = 24
    size: Annotated[int, at_least(1, "pixels")] = SMALL_SIDE
    split: str = "held-out"
    seed: Seed = 0

    def __post_init__(self) -> None:
        check(self)
        check_choice("split", self.split, SPLITS)


@dataclass(frozen=True, slots=True, kw_only=True)
class SplatConfig(Checked):
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

    views: Annotated[int, at_least(1)] = 16
    samples: Annotated[int, at_least(1)] = 12
    objects: Count = 12_000
    surroundings: Count = 30_000
    sky: Count = 1_500
    steps: Annotated[int, at_least(0, "steps")] = 100
    pictures: Count = 4


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainConfig(Checked):
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

    pretraining: Annotated[int, at_least(0, "steps")] = 1000
    epochs: Annotated[int, at_least(1, "epochs")] = 20
    batch: Annotated[int, at_least(1, "pictures")] = 8
    learning_rate: Annotated[float, above(0), Called("RATE")] = 1.2e-3
    warm_up: Fraction = 0.06
    weight_decay: Annotated[float, at_least(0)] = 0.02
    ema_decay: Share = 0.998
    max_gradient_norm: Annotated[float, above(0)] = 5.0
    mixed_precision: bool = True
    low_resolution: Annotated[int, at_least(1, "pixels")] = 160
    low_resolution_fraction: Fraction = 0.4
    final_fraction: Fraction = 0.2
    seed: Seed = 0
