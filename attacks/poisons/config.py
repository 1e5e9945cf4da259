"""Options of Poison-splat, of its controls and of defences against it, and of M-IFGSM;
light, for studies and flags.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal, cast

from mi_splat.errors import InvalidValueError
from mi_splat.fields import (
    Checked,
    Converter,
    Fraction,
    Metavar,
    Range,
    Steps,
    above,
    at_least,
    between,
    check,
    check_choice,
)

Variation = Literal["both", "vertical"]
"""Total variation along both axes of an image, or along its columns alone as the
public implementation has it.
"""
PictureFilter = Literal["blur", "fourier", "wavelet"]

Paste = Literal["resized", "difference", "direct"]
CLIP_DEVIATION = (0.26862954, 0.26130258, 0.27577711)
"""Standard deviation of each channel by which CLIP divides, sRGB."""

Eps = Annotated[int, between(0, 255, "steps of 1/255", "8, 16 and 24 are the paper's")]

_STRENGTHS: dict[PictureFilter, tuple[float, Range]] = {
    "blur": (
        1.5,
        Range(low=0, high=10, open_low=True, unit="pixels", do="1.5 is usual"),
    ),
    "fourier": (
        0.5,
        Range(
            low=0,
            high=1,
            open_low=True,
            unit="share of the frequencies",
            do="0.5 is usual",
        ),
    ),
    "wavelet": (
        16.0,
        Range(low=0, high=255, open_low=True, unit="steps of 1/255", do="16 is usual"),
    ),
}
"""Usual strength of each filter, and what else it may be."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FilterConfig:
    """A filter of images, see `attacks.poisons.defences.filtered`.

    Attributes:
        name: Which.
        strength: Of "blur" the standard deviation, pixels; of "fourier" the share of
            the frequencies along each axis that stay; of "wavelet" the size of the
            detail that goes, steps of 1/255. None is 1.5, 0.5 and 16.

    Raises:
        InvalidValueError: The filter has no such strength.
    """

    name: PictureFilter = "blur"
    strength: float | None = None

    def __post_init__(self) -> None:
        check(self)
        allowed = _STRENGTHS[self.name][1]
        if self.strength is not None and not allowed.holds(self.strength):
            raise InvalidValueError.of(
                f"strength of {self.name}", str(allowed), self.strength, allowed.do
            )

    @property
    def amount(self) -> float:
        """The strength, the usual one if none is named."""
        if self.strength is None:
            return _STRENGTHS[self.name][0]
        return self.strength


def _filter_of(word: str) -> FilterConfig:
    name, _, strength = word.partition(":")
    check_choice("filter", name, tuple(_STRENGTHS))
    return FilterConfig(
        name=cast(PictureFilter, name), strength=float(strength) if strength else None
    )


Through = Annotated[
    FilterConfig | None,
    Converter(_filter_of, lambda config: f"{config.name}:{config.amount:g}"),
    Metavar("FILTER[:STRENGTH]"),
]
"""A filter, on the command line blur, fourier or wavelet:24 for instance."""


@dataclass(frozen=True, slots=True, kw_only=True)
class UniformNoiseConfig(Checked):
    """Noise that raises nothing on purpose.

    Attributes:
        eps: Largest change of a channel, in steps of 1/255.
        share: Part of the images that is changed, drawn by the seed.
    """

    eps: Eps = 16
    share: Fraction = 1.0


@dataclass(frozen=True, slots=True, kw_only=True)
class RaisedVariationConfig(Checked):
    """Total variation that is raised image by image, with nothing that holds the
    images together.

    Attributes:
        eps: Largest change of a channel, in steps of 1/255.
        share: Part of the images that is changed, drawn by the seed.
        variation: What is raised.
        variation_steps: Steps along the sign of its gradient, each of 2/255 as in the
            paper.
        through: A filter through which the variation is looked at; None looks at the
            image itself.
    """

    eps: Eps = 16
    share: Fraction = 1.0
    variation: Variation = "both"
    variation_steps: Steps = 15
    through: Through = None


@dataclass(frozen=True, slots=True, kw_only=True)
class PoisonSplatConfig(Checked):
    """Poison-splat (arXiv 2410.08190); published with 36,000 steps for objects.

    Without a ball it was published with 6,000 steps, of which every tenth moves the
    decoy, and 25 `variation_steps`.

    Attributes:
        eps: Largest change of a channel, in steps of 1/255; None sets no ball: the
            images are the decoy's.
        steps: Of the decoy; each looks at one camera.
        share: Part of the images that is changed, drawn by the seed. The decoy looks
            at all cameras anyway, and what a small share changes is among what a larger
            one does.
        variation: What is raised.
        variation_steps: Steps along the sign of its gradient, at each camera anew, each
            of 2/255 as in the paper.
        decoy_every: Cameras whose gradients are summed in one step of the decoy's
            optimiser.
        densify_every: Steps between two rounds in which the decoy is cloned, split and
            pruned; 0 never does it. These rounds also remove what is large, as the
            victim's do once opacities were reset.
        max_gaussians: The decoy is not made larger than this; None sets no limit.
        through: A filter of images that the victim is known to use: variation and the
            decoy's loss are those of what it leaves. None knows of no filter.
    """

    eps: Eps | None = 16
    steps: Steps = 2000
    share: Fraction = 1.0
    variation: Variation = "both"
    variation_steps: Steps = 15
    decoy_every: Steps = 1
    densify_every: Annotated[int, at_least(0, "steps", "0 never does it")] = 100
    max_gaussians: (
        Annotated[int, at_least(1, "Gaussians", "leave it out for no limit")] | None
    ) = None
    through: Through = None


@dataclass(frozen=True, slots=True, kw_only=True)
class FrequencyPruningConfig(Checked):
    """Pruning of a splat by the frequencies that its cameras can see.

    Attributes:
        samples: Gaussians whose middle axis is shorter than this many samples of the
            camera that sees them finest are removed; one sample is the size of a pixel
            there.
    """

    samples: Annotated[
        float, above(0, "samples", "0.2 is usual; Mip-Splatting smooths to 0.45")
    ] = 0.2


@dataclass(frozen=True, slots=True, kw_only=True)
class MIFGSMConfig(Checked):
    """M-IFGSM (arXiv 2412.02803), as published unless told otherwise.

    Attributes:
        eps: Largest change of a channel, in steps of 1/255; None sets no ball.
        steps: Along the sign of the gradient.
        step: Length of each, in units of `deviation`.
        deviation: Of each channel, sRGB. CLIP's, so that the change is the same whoever
            is deceived.
        share: Part of the images that is changed, drawn by the seed.
        paste: "resized": the image that was changed at the classifier's size, brought
            back to its own, takes the object's place, as published; a larger image
            loses detail there. "difference": only the change is brought back, and
            added. "direct": the image itself is changed, through the classifier's
            scaling.
        target: Class that the object shall be taken for; None is any but its own, as
            published.
        through: A filter through which the classifier is shown the image while it is
            changed, for instance one that a victim is known to use, or a blur: what
            survives it survives a training better. None is as published.
        least_confidence: Images in whose true class the classifier is less confident
            stay as they are.
        decoy_steps: A decoy, a splat of the clean images, looks at so many cameras;
            the steps along the gradient begin at its image, it learns where they end,
            and its images take the object's place. So the changes of all cameras
            agree. 0 is as published: each image by itself.
    """

    eps: Eps | None = None
    steps: Steps = 30
    step: Annotated[float, above(0, "standard deviations", "0.02 is the paper's")] = (
        0.02
    )
    deviation: tuple[float, float, float] = CLIP_DEVIATION
    share: Fraction = 1.0
    paste: Paste = "resized"
    target: str | None = None
    through: FilterConfig | None = None
    least_confidence: Fraction = 0.05
    decoy_steps: Annotated[
        int, at_least(0, "steps", "400 is usual; 0 is without a decoy")
    ] = 0
