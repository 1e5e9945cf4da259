"""What an attack on a distribution of views did, and the warnings about it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import polars as pl

from attacks.dagger.eot.config import EotConfig
from attacks.dagger.eot.judging import Judgement
from attacks.dagger.eot.rates import AIMS, NOISE, aim_rates, found_rates
from attacks.objectives import Objective
from attacks.pgd import Step
from attacks.rate import Rate
from attacks.transformations.config import Transformations
from mi_splat.scene import GaussianScene

PSNR_SLACK = 0.5
"""How far the held-out pictures may be below the image budget before a result warns of it, dB."""

_COUNTED = ("index", "detector", "azimuth", "elevation", *AIMS, NOISE, "clean_confidence", "original_confidence")
"""Keys of a row that rates are counted from."""


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
    def rows(self) -> list[dict[str, Any]]:
        """The held-out views, one row for each view and detector, as JSON can hold it."""
        return self.judgement.rows(self.originals, self.objective.label)

    @property
    def frame(self) -> pl.DataFrame:
        """What the rates are counted from, see `attacks.dagger.eot.rates`."""
        rows = [{key: row[key] for key in _COUNTED} for row in self.rows]
        return pl.DataFrame(rows, infer_schema_length=None).with_columns(
            original=pl.Series([self.originals[row["detector"]] for row in rows], dtype=pl.String),
            noise_successes=pl.Series([row[NOISE] for row in rows], dtype=pl.List(pl.Boolean)),
        )

    @property
    def rate(self) -> Rate:
        """Held-out views in which every detector is deceived."""
        return self.rates["success"]

    @property
    def rates(self) -> dict[str, Rate]:
        """How often the aim is reached, see `attacks.dagger.eot.rates.aim_rates`."""
        return aim_rates(self.frame)

    @property
    def success(self) -> bool:
        """Whether the aim was reached in enough held-out views."""
        return self.rate.fraction >= self.config.required_views - 1e-9


def find_warnings(result: EotResult) -> tuple[str, ...]:
    """Signs that success or failure is not what it looks like."""
    found, rows, rates = [], result.frame, result.rates
    for name in result.detectors:
        seen = found_rates(rows.filter(detector=name))["found_clean"]
        if seen.fraction < 0.5:
            found.append(f"{name} finds the clean object in {seen.successes} of {seen.total} held-out views only")
    clean, noise, rate = rates["clean_success"], rates[NOISE], rates["unambiguous"]
    if clean.successes:
        found.append(f"the aim is reached without any attack in {clean.successes} of {clean.total} views")
    if result.best.success and not result.success:
        found.append("success on the validation views did not carry over to the held-out views")
    if noise.total and result.rate.successes and noise.fraction >= result.rate.fraction:
        found.append("random noise of the same size does as well")
    if result.success and rate.fraction < result.config.required_views:
        found.append(
            f"without another class of more confidence on the object: {rate.successes} of {rate.total} views only"
        )
    wanted, psnr = result.config.image_psnr, result.judgement.image.psnr
    if wanted is not None and psnr is not None and psnr < wanted - PSNR_SLACK:
        found.append(f"the held-out pictures have {psnr:.1f} dB: less than the {wanted:g} dB of the validation views")
    return tuple(found)
