"""What an attack on a distribution of views did, and the warnings about it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from attacks.dagger.eot.config import EotConfig
from attacks.dagger.eot.judging import JudgedView, Judgement
from attacks.evaluation.rates import Rate
from attacks.objectives import Objective
from attacks.pgd import Step
from attacks.transformations.config import Transformations
from mi_splat.scene import GaussianScene

PSNR_SLACK = 0.5
"""How far the held-out pictures may be below the image budget before a result warns of it, dB."""


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class EotResult:
    """What an attack did, judged on held-out views.

    Attributes:
        scene: The attacked scene; Gaussians outside the object are bit for bit what they were.
        judgement: The held-out views.
        trace: Every point that was looked at; only some were judged by the validation views.
        best: The line of the trace whose point was kept.
        used: Size of the perturbation by attribute; never above its radius.
        used_in_file: The same, measured on the saved file.
        object_gaussians: Number of Gaussians of the object.
        changed_gaussians: Number of Gaussians that differ.
        redraws: Cameras drawn in vain, as they did not show the object: held-out, validation and attacked views.
        originals: What each detector calls the clean object in most validation views.
        warnings: Reasons to look twice before the result is believed, in words.
        objective: The aim and its settings.
        transformations: The distribution that it was made for.
        judged: The distribution that judged it.
        config: How it was attacked.
        origin: Detectors, versions, variant, commit, scene hash.
        seconds: Wall time of search and judgement.
    """

    scene: GaussianScene
    judgement: Judgement
    trace: tuple[Step, ...]
    best: Step
    used: dict[str, float]
    used_in_file: dict[str, float]
    object_gaussians: int
    changed_gaussians: int
    redraws: dict[str, int]
    originals: Mapping[str, str | None]
    warnings: tuple[str, ...]
    objective: Objective
    transformations: Transformations
    judged: Transformations
    config: EotConfig
    origin: dict[str, Any]
    seconds: float

    @property
    def detectors(self) -> tuple[str, ...]:
        """Names of the attacked detectors."""
        return tuple(self.originals)

    @property
    def rate(self) -> Rate:
        """Held-out views in which every detector is deceived."""
        return self.judgement.success()

    @property
    def success(self) -> bool:
        """Whether the aim was reached in enough held-out views."""
        return self.rate.fraction >= self.config.required_views - 1e-9


def found_rate(result: EotResult, detector: str, *, attacked: bool, min_confidence: float = 0.5) -> Rate:
    """Held-out views in which a detector reports the object as what it calls the clean one in most views.

    Args:
        result: The attack.
        detector: Its name.
        attacked: In the attacked pictures, or in the clean ones.
        min_confidence: Confidence from which a report counts.
    """
    label = result.originals[detector]
    views = [one for one in result.judgement.views if one.detector == detector]
    return Rate.of(views, lambda one: label is not None and one.confidence(label, attacked=attacked) >= min_confidence)


def by_angle(
    result: EotResult, angle: Callable[[JudgedView], float], interval: tuple[float, float], parts: int
) -> list[dict[str, Any]]:
    """Success over an angle: the held-out views in equal parts of an interval.

    Args:
        result: The attack.
        angle: Of a view, degrees in the interval.
        interval: Degrees.
        parts: Number of parts.
    """
    return binned([(angle(one), one.verdict.success) for one in result.judgement.views], interval, parts)


def binned(outcomes: Sequence[tuple[float, bool]], interval: tuple[float, float], parts: int) -> list[dict[str, Any]]:
    """How often something holds, over an angle: equal parts of an interval.

    Args:
        outcomes: Angle in degrees, and whether it holds there.
        interval: Degrees.
        parts: Number of parts.
    """
    low, width = interval[0], (interval[1] - interval[0]) / parts
    if not width:
        return []
    places = [min(parts - 1, max(0, int((angle - low) / width))) for angle, _ in outcomes]
    lines = []
    for part in range(parts):
        inside = [holds for (_, holds), place in zip(outcomes, places, strict=True) if place == part]
        rate = Rate(successes=sum(inside), total=len(inside))
        lines.append({"from": low + part * width, "to": low + (part + 1) * width, **rate.as_dict()})
    return lines


def find_warnings(result: EotResult) -> tuple[str, ...]:
    """Signs that success or failure is not what it looks like."""
    found, judgement = [], result.judgement
    for name in result.detectors:
        seen = found_rate(result, name, attacked=False)
        if seen.fraction < 0.5:
            found.append(f"{name} finds the clean object in {seen.successes} of {seen.total} held-out views only")
    if judgement.clean().successes:
        clean = judgement.clean()
        found.append(f"the aim is reached without any attack in {clean.successes} of {clean.total} views")
    if result.best.success and not result.success:
        found.append("success on the validation views did not carry over to the held-out views")
    noise = judgement.noise()
    if noise.total and result.rate.successes and noise.fraction >= result.rate.fraction:
        found.append("random noise of the same size does as well")
    if result.success and judgement.unambiguous().fraction < result.config.required_views:
        rate = judgement.unambiguous()
        found.append(
            f"without another class of more confidence on the object: {rate.successes} of {rate.total} views only"
        )
    wanted, psnr = result.config.image_psnr, judgement.image.psnr
    if wanted is not None and psnr is not None and psnr < wanted - PSNR_SLACK:
        found.append(f"the held-out pictures have {psnr:.1f} dB: less than the {wanted:g} dB of the validation views")
    return tuple(found)
