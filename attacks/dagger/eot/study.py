"""A study of distributions of views: which radius is enough, and what views, SH degree and attributes are worth.

Attacks are asked for one by one, since a search for a radius needs the results so far. A result is stored as soon as it
is there (`attacks.dagger.study.run_jobs`), so an interrupted study goes on where it stopped.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from attacks.dagger.eot.config import EotConfig
from attacks.dagger.eot.jobs import EotJob
from attacks.dagger.study import PAIRS
from attacks.limits import SearchName
from attacks.transformations.config import PictureChanges, Transformations
from mi_splat.attributes import Attribute

Ask = Callable[[EotJob], Mapping[str, Any]]
"""Runs one attack, or finds its stored result; returns the summary."""

RADII = (0.02, 0.03, 0.045, 0.07, 0.1, 0.14, 0.2, 0.3)
"""Of linf balls over SH: where the smallest radius is looked for, and the curve."""

POOLS = (1, 8, 64, 0)
"""Numbers of views that an attack draws from; 0 draws new ones at each step."""

PSNRS = (30.0, 26.0)
"""Image budgets, dB, at which attributes are compared."""

PSNR_SLACK, PSNR_ATTEMPTS = 0.3, 4
"""How near the PSNR of an attack comes to the budget, dB, and after how many attacks we give up."""

MIXTURES: tuple[dict[Attribute, float], ...] = (
    {"sh": 0.15},
    {"means": 0.015},
    {"scales": 0.5},
    {"rotations": 0.2},
    {"opacities": 2.0},
    {"sh": 0.1, "opacities": 1.0},
    {"sh": 0.1, "means": 0.005, "scales": 0.1, "rotations": 0.05, "opacities": 0.5},
)
"""Attributes that may change together, with the radii that the search begins with; it scales them by one factor."""

PHOTOGRAPHED = PictureChanges(exposure=0.3, white_balance=0.1, gamma=0.15, blur=1.0, resize=0.6, noise=0.03, jpeg=40)
"""What may happen to a picture on its way to the detector, for the table of picture changes."""


@dataclass(frozen=True, slots=True, kw_only=True)
class StudySetup:
    """What all attacks of a study have in common.

    Attributes:
        detectors: Names of the detectors that are attacked at once.
        confidence: What counts as success; None is the objective's own.
        config: How to attack.
        transformations: The views.
        search: What a relabelling pushes (`EotJob`).
        pairs: Scene, id of the object in it, target class. Curves are made for the first one.
    """

    detectors: tuple[str, ...]
    confidence: float | None = None
    config: EotConfig = field(default_factory=EotConfig)
    transformations: Transformations = field(default_factory=Transformations)
    search: SearchName = "paper"
    pairs: tuple[tuple[str, str, str], ...] = PAIRS

    def job(self, group: str, pair: tuple[str, str, str] | None = None, **changes: Any) -> EotJob:
        """An attack on a pair, the first if none is named, with changes of the configuration."""
        scene, name, target = pair or self.pairs[0]
        return EotJob(
            group=group,
            scene=scene,
            object=name,
            target=target,
            detectors=self.detectors,
            confidence=self.confidence,
            config=dataclasses.replace(self.config, **changes),
            transformations=self.transformations,
            search=self.search,
        )


def pairs(ask: Ask, setup: StudySetup) -> None:
    """Every pair with the study's own radius."""
    for pair in setup.pairs:
        ask(setup.job("pairs", pair))


def smallest(ask: Ask, setup: StudySetup) -> None:
    """For every pair the smallest of `RADII` with success, by bisection: success is taken to rise with the radius."""
    for pair in setup.pairs:
        low, high = -1, len(RADII)  # fails, succeeds
        while high - low > 1:
            middle = (low + high) // 2
            if ask(setup.job("smallest", pair, eps=(RADII[middle],)))["success"]:
                high = middle
            else:
                low = middle


def curve(ask: Ask, setup: StudySetup) -> None:
    """The first pair at every other radius."""
    for eps in RADII[1::2]:
        ask(setup.job("curve", eps=(eps,)))


def pool(ask: Ask, setup: StudySetup) -> None:
    """The first pair with one camera, a few, many, and new ones at each step."""
    for count in POOLS:
        ask(setup.job("pool", pool=count))


def degree(ask: Ask, setup: StudySetup) -> None:
    """The first pair with colours that change the same from everywhere, and with more and more freedom."""
    for highest in range(4):
        ask(setup.job("degree", sh_degree=highest))


def changes(ask: Ask, setup: StudySetup) -> None:
    """The first pair made for plain and for changed pictures, and judged on both."""
    plain = dataclasses.replace(setup.transformations, pictures=PictureChanges())
    changed = dataclasses.replace(setup.transformations, pictures=PHOTOGRAPHED)
    for made in (plain, changed):
        for judged in (plain, changed):
            ask(dataclasses.replace(setup.job("changes"), transformations=made, judged=judged))


def attributes(ask: Ask, setup: StudySetup) -> None:
    """The first pair with every attribute and some mixtures, each at the radius that uses the image budget up."""
    for psnr in PSNRS:
        for radii in MIXTURES:
            at_psnr(lambda job: ask(job)["image_psnr"], setup, radii, psnr)


def at_psnr(
    measure: Callable[[EotJob], float | None], setup: StudySetup, radii: Mapping[Attribute, float], psnr: float
) -> None:
    """Scale radii until the attack's pictures have a PSNR.

    The first guess is that a change grows with the radius: a factor of 10 takes 20 dB. After that, the line through the
    last two attacks.

    Args:
        measure: Attacks; returns the PSNR of the held-out pictures, None when nothing changed.
        setup: The study.
        radii: By attribute, where to begin.
        psnr: Wanted, dB.
    """
    names, first = tuple(radii), [radii[name] for name in radii]
    scale, slope, before = 0.0, -20.0, None  # decades; dB for a decade
    for _ in range(PSNR_ATTEMPTS):
        eps = tuple(float(f"{value * 10**scale:.4g}") for value in first)
        found = measure(setup.job(f"attributes{psnr:.0f}", attributes=names, eps=eps))
        if found is None or abs(found - psnr) <= PSNR_SLACK:
            return
        if before is not None and scale != before[0]:
            slope = min(-4.0, (found - before[1]) / (scale - before[0]))
        before = (scale, found)
        scale += max(-1.0, min(1.0, (psnr - found) / slope))


GROUPS: dict[str, Callable[[Ask, StudySetup], None]] = {
    "pairs": pairs,
    "smallest": smallest,
    "curve": curve,
    "pool": pool,
    "degree": degree,
    "changes": changes,
    "attributes": attributes,
}
"""Name of a part of the study to what asks for its attacks."""


def nearest_to(records: list[Mapping[str, Any]], psnr: float) -> list[Mapping[str, Any]]:
    """For each mixture of attributes the attack whose PSNR is nearest to the budget."""
    best: dict[tuple[str, ...], Mapping[str, Any]] = {}

    def gap(record: Mapping[str, Any]) -> float:
        found = record["result"]["image_psnr"]
        return math.inf if found is None else abs(found - psnr)

    for record in records:
        names = tuple(record["job"]["config"]["attributes"])
        if names not in best or gap(record) < gap(best[names]):
            best[names] = record
    return list(best.values())
