"""A study of distributions of views: which radius is enough, and what views, SH degree and attributes are worth.

Attacks are asked for one by one, since a search for a radius needs the results so far. A result is stored as soon as it
is there (`attacks.dagger.study.run_jobs`), so an interrupted study goes on where it stopped.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from attacks.dagger.config import EotConfig
from attacks.dagger.eot.jobs import EotJob
from attacks.dagger.study import PAIRS
from attacks.limits import SearchName
from attacks.transformations.config import PictureChanges, Transformations
from mi_splat.attributes import Attribute

Ask = Callable[[EotJob], Mapping[str, Any]]
"""Runs one attack, or finds its stored result; returns the summary."""

RADII = (0.03, 0.05, 0.08, 0.12, 0.18, 0.25, 0.35, 0.5, 0.7, 1.0, 1.4)
"""Of linf balls over SH: where the smallest radius is looked for, without a limit on the pictures."""

CURVE = (0.05, 0.12, 0.25, 0.5)
"""Radii of the curve."""

POOLS = (1, 8, 64, 0)
"""Numbers of views that an attack draws from; 0 draws new ones at each step."""

PSNRS = (30.0, 26.0)
"""Image budgets, dB, at which attributes are compared."""

PSNR_CURVE = (36.0, 34.0, 32.0, 30.0, 28.0, 26.0)
"""Image budgets, dB, of the curve."""

MARGIN = 0.3
"""Added to an image budget, dB: the search holds it on its validation views, and others judge."""

MIXTURES: tuple[dict[Attribute, float], ...] = (
    {"sh": 1.0},
    {"means": 0.1},
    {"scales": 1.5},
    {"rotations": 1.0},
    {"opacities": 4.0},
    {"sh": 1.0, "opacities": 4.0},
    {"means": 0.1, "scales": 1.5, "rotations": 1.0},
    {"sh": 1.0, "means": 0.05, "scales": 0.75, "rotations": 0.5, "opacities": 2.0},
)
"""Attributes that may change together, with radii so large that the pictures are what binds."""

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
            if ask(setup.job("smallest", pair, eps=(RADII[middle],), image_psnr=None))["success"]:
                high = middle
            else:
                low = middle


def curve(ask: Ask, setup: StudySetup) -> None:
    """The first pair at every other radius."""
    for eps in CURVE:
        ask(setup.job("curve", eps=(eps,), image_psnr=None))


def psnr(ask: Ask, setup: StudySetup) -> None:
    """The first pair at every image budget."""
    for limit in PSNR_CURVE:
        ask(setup.job("psnr", image_psnr=limit + MARGIN))


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
    """The first pair with every attribute and some mixtures, at equal image budgets."""
    for limit in PSNRS:
        for radii in MIXTURES:
            ask(
                setup.job(
                    f"attributes{limit:.0f}",
                    attributes=tuple(radii),
                    eps=tuple(radii.values()),
                    image_psnr=limit + MARGIN,
                )
            )


GROUPS: dict[str, Callable[[Ask, StudySetup], None]] = {
    "pairs": pairs,
    "smallest": smallest,
    "curve": curve,
    "psnr": psnr,
    "pool": pool,
    "degree": degree,
    "changes": changes,
    "attributes": attributes,
}
"""Name of a part of the study to what asks for its attacks."""
