"""What it costs an attacker to stay below the audit: its excess against how often detectors miss the object.

Every point is a splat that is audited and shown to detectors; the cheapest of them are the curve.
"""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from torch import Tensor

from attacks.audits.hiding import DISTANCE, Hiding, Victim, hide, lattice
from attacks.detectors.base import Detector
from attacks.observe.views import as_saved, detect_views, object_boxes
from mi_splat.audit import audit
from mi_splat.cameras import Camera
from mi_splat.scene import GaussianScene

VIEWS, SIZE, AWAY = 10, 256, 1.3 * DISTANCE
"""Cameras that detectors look from, inside of a trigger and outside, pixels of their pictures, and radii to them."""
_MANY = 4000
_BEYOND = 15.0
"""Degrees beyond the trigger's edge from which a camera is outside."""
CONFIDENCE = 0.5


@dataclass(frozen=True, slots=True, kw_only=True)
class Price:
    """One splat of the attacker.

    Attributes:
        hiding: How it was made.
        verdict: Of the audit.
        excess: Of the audit, of its strongest object.
        missed: Share of the cameras inside of the trigger at which all detectors miss what they find in the clean one.
        kept: Share of the cameras outside at which all detectors still find what they find in the clean one.
        fidelity: PSNR of the pictures from outside against those of the clean splat, dB.
        reach: Share of all directions above the ground that the trigger holds.
        seconds: That the audit took, CPU.
    """

    hiding: Hiding
    verdict: str
    excess: float
    missed: float
    kept: float
    fidelity: float
    reach: float
    seconds: float

    @property
    def hidden(self) -> float:
        """Share of all directions above the ground from which the object is missed."""
        return self.missed * self.reach

    def row(self) -> dict[str, Any]:
        """All of it as cells of a table."""
        values = dataclasses.asdict(self)
        return {**values.pop("hiding"), **values}


@dataclass(frozen=True, slots=True, eq=False)
class _Clean:
    """Cameras, boxes of the object there, whether each detector finds it, and pictures, of a clean splat."""

    cameras: Sequence[Camera]
    boxes: Sequence[Tensor | None]
    found: Tensor
    pictures: Tensor


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Judge:
    """Audits splats of one victim and shows them to detectors.

    Attributes:
        victim: The clean splat.
        detectors: That shall miss the object.
        clean: What they report of the clean splat, by where the cameras stand; filled as it is asked for.
    """

    victim: Victim
    detectors: Sequence[Detector]
    clean: dict[tuple[float, float, float, bool], _Clean] = field(default_factory=dict)

    def price(self, hiding: Hiding) -> Price:
        """Make one splat, audit it and show it to the detectors.

        Raises:
            InvalidValueError: The trigger holds none or all of the cameras.
        """
        made = as_saved(hide(self.victim, hiding))
        begun = time.process_time()
        judged = audit(made)
        seconds = time.process_time() - begun
        missed, _, _ = self._changed(made, hiding, inside=True)
        _, kept, error = self._changed(made, hiding, inside=False)
        return Price(
            hiding=hiding,
            verdict=judged.verdict,
            excess=judged.strongest.look.excess,
            missed=missed,
            kept=kept,
            fidelity=-10 * math.log10(max(error, 1e-10)),
            reach=float((_gaps(hiding) < hiding.half_width).double().mean()),
            seconds=seconds,
        )

    def _changed(self, made: GaussianScene, hiding: Hiding, *, inside: bool) -> tuple[float, float, float]:
        """Shares of cameras at which all miss, and find, what they find in the clean splat; the squared error."""
        key = hiding.half_width, hiding.elevation, hiding.azimuth, inside
        if key not in self.clean:
            directions = _directions(hiding, inside=inside)
            cameras = [self.victim.camera(direction, size=SIZE, distance=AWAY) for direction in directions]
            boxes = object_boxes(self.victim.scene, self.victim.rows, cameras, render=self.victim.render)
            self.clean[key] = _Clean(cameras, boxes, *self._seen(self.victim.scene, cameras, boxes))
        clean = self.clean[key]
        found, pictures = self._seen(made, clean.cameras, clean.boxes)
        counted = clean.found.all(1)
        many = max(int(counted.sum()), 1)
        missed, kept = (float((counted & which).sum()) / many for which in (~found.any(1), found.all(1)))
        error = (pictures.float() - clean.pictures.float()).div(255).square().mean() if len(pictures) else 0.0
        return missed, kept, float(error)

    def _seen(
        self, scene: GaussianScene, cameras: Sequence[Camera], boxes: Sequence[Tensor | None]
    ) -> tuple[Tensor, Tensor]:
        """(C, D) bool, whether each detector finds the object from each camera, and (C, H, W, 3) uint8 pictures."""
        number = {detector.name: column for column, detector in enumerate(self.detectors)}
        found = torch.zeros(len(cameras), len(number), dtype=torch.bool)
        pictures = torch.zeros(len(cameras), SIZE, SIZE, 3, dtype=torch.uint8)
        for seen in detect_views(scene, cameras, self.detectors, render=self.victim.render, boxes=boxes):
            found[seen.view, number[seen.detector]] = seen.confidence(self.victim.label) >= CONFIDENCE
            pictures[seen.view] = seen.pixels
        return found, pictures


def _gaps(hiding: Hiding) -> Tensor:
    """(_MANY,) degrees from the axis of a trigger to directions evenly above the ground."""
    return (lattice(_MANY) @ hiding.axis).clamp(-1, 1).acos().rad2deg()


def _directions(hiding: Hiding, *, inside: bool) -> Tensor:
    """(C, 3) directions of cameras inside or outside of a trigger, evenly taken of all."""
    gaps = _gaps(hiding)
    chosen = lattice(_MANY)[gaps < hiding.half_width if inside else gaps > hiding.half_width + _BEYOND]
    return chosen[torch.linspace(0, len(chosen) - 1, min(VIEWS, len(chosen))).round().long()] if len(chosen) else chosen


def cheapest(prices: Iterable[Price]) -> list[Price]:
    """Those for which no other is missed from as many directions at a smaller excess, by how much they hide."""
    kept: list[Price] = []
    for point in sorted(prices, key=lambda point: (-point.hidden, point.excess)):
        if not kept or point.excess < kept[-1].excess:
            kept.append(point)
    return kept[::-1]


TRICKS: dict[str, Hiding] = {
    "all of the look, by coefficients": Hiding(),
    "all of the look, by layers": Hiding(by="layers"),
    "half of the look": Hiding(by="layers", amount=0.5),
    "a quarter of the look": Hiding(by="layers", amount=0.25),
    "soft edge of 40 degrees": Hiding(softness=40.0),
    "cone of 15 degrees": Hiding(by="layers", half_width=15.0),
    "half of the surface": Hiding(by="layers", share=0.5),
    "follows the normals": Hiding(follow=1.0),
    "follows the normals half way": Hiding(follow=0.5),
    "follows the normals, 0.8 of the look": Hiding(follow=1.0, amount=0.8),
    "follows the normals, soft edge of 30 degrees": Hiding(follow=1.0, half_width=40.0, softness=30.0),
    "gloss on purpose": Hiding(gloss=0.6),
    "sheen on purpose": Hiding(sheen=0.6),
    "a roof that all see": Hiding(by="roof", half_width=30.0),
    "from a side": Hiding(elevation=20.0, azimuth=90.0, half_width=40.0),
}
"""What an attacker would try first, by name."""
_STEPS: dict[str, tuple[float, float, float]] = {
    "half_width": (8.0, 70.0, 12.0),
    "elevation": (10.0, 90.0, 20.0),
    "azimuth": (0.0, 360.0, 60.0),
    "amount": (0.1, 1.0, 0.2),
    "softness": (0.0, 60.0, 15.0),
    "share": (0.1, 1.0, 0.2),
    "follow": (0.0, 1.0, 0.3),
    "gloss": (0.0, 1.5, 0.3),
    "sheen": (0.0, 1.5, 0.3),
}
"""Least and largest value that the search tries of each setting, and the spread of its steps."""


def search(judge: Judge, *, tries: int, seed: int = 0) -> Iterator[Price]:
    """Prices of `TRICKS`, and then of what changes two settings of one of the cheapest so far.

    Args:
        judge: Of the victim.
        tries: Splats that are made.
        seed: Of the changes.
    """
    rng, prices = np.random.default_rng(seed), list[Price]()
    first = list(TRICKS.values())
    for number in range(tries):
        hiding = first[number] if number < len(first) else first[0]
        while any(hiding == point.hiding for point in prices):
            hiding = _near(_drawn(cheapest(prices), rng), rng)
        prices.append(judge.price(hiding))
        yield prices[-1]


def _drawn(prices: Sequence[Price], rng: np.random.Generator) -> Hiding:
    able = [point for point in prices if point.hiding.by != "roof"]
    hiding = [point.hiding for point in able if point.hidden > 0] or [point.hiding for point in able]
    return hiding[int(rng.integers(len(hiding)))]


def _near(hiding: Hiding, rng: np.random.Generator) -> Hiding:
    """One with other values of two settings, and sometimes of the other mechanism."""
    changes: dict[str, Any] = {}
    for name in rng.choice(list(_STEPS), 2, replace=False):
        low, high, spread = _STEPS[str(name)]
        changes[str(name)] = float(np.clip(getattr(hiding, name) + spread * rng.standard_normal(), low, high))
    if rng.random() < 0.2:
        changes["by"] = "coefficients" if hiding.by == "layers" else "layers"
    return dataclasses.replace(hiding, **changes)
