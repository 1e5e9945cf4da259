"""What hiding from the audit costs: `python -m scenes.recipes.audit_price FILE.csv
OBJECT [TRIES]`.

Every row is a splat that is audited and shown to detectors: its drift net of gloss, and
how often they miss it. With TRIES the attacker searches on the object; without, all
that he would try first and what is cheapest in FILE is reported on it. Rows are added
to FILE.
"""

import csv
import dataclasses
import math
import sys
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from attacks.detectors.base import Detector
from attacks.detectors.registry import load_detector
from attacks.observe.views import as_saved, detect_views, object_boxes
from mi_splat.audit import audit
from mi_splat.io import load_splat
from mi_splat.render.renderer import Renderer, RenderSettings
from mi_splat.scene import GaussianScene, merge
from scenes.recipes.audit_hiding import DISTANCE, Hiding, Victim, hide, lattice
from tests.audit.scenes import standing

Row = dict[str, Any]
"""Settings of a `Hiding`; the audit's `verdict`, `net` of its strongest object, and CPU
`seconds`; the shares `missed` of cameras inside of the trigger at which all detectors
miss what they find in the clean splat, and `kept` of those outside at which all still
find it; `fidelity`, PSNR from outside against the clean splat, dB; `reach`, the share
of all directions above the ground that the trigger holds.
"""
SCENES = Path(__file__).parents[1]
SHIPPED = {
    "car": ("car_street_car", "car_street_street"),
    "stop sign": ("stop_sign_stop_sign", "stop_sign_roadside"),
}
"""Object to the files of it and of what is around it."""
DETECTORS = ("fasterrcnn_small",)
COUNT = 1200
"""Discs of an object that is not shipped."""
SEARCHED = "searched"
VIEWS = 10
SIZE = 256
AWAY = 1.3 * DISTANCE
"""Cameras that detectors look from, inside of a trigger and outside, pixels of their
pictures, and radii to them.
"""
CONFIDENCE = 0.5
_MANY = 4000
_BEYOND = 15.0
"""Degrees beyond the trigger's edge from which a camera is outside."""
_AROUND = 2.4
"""Radii of a shipped object around it within which its surroundings are kept: enough
for a ground, and quicker.
"""
_RENDER = Renderer(RenderSettings(background=(0.55, 0.7, 0.9)))
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
    "follows the normals, soft edge of 30 degrees": Hiding(
        follow=1.0, half_width=40.0, softness=30.0
    ),
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
"""Least and largest value that the search tries of each setting, and the spread of its
steps.
"""


@dataclass(frozen=True, kw_only=True, eq=False)
class Judge:
    """Audits splats of one victim, and shows them to detectors that shall miss its
    object.
    """

    victim: Victim
    detectors: Sequence[Detector]
    clean: dict[tuple[float, float, float, bool], tuple[Any, ...]] = field(
        default_factory=dict
    )
    """Cameras, boxes of the object there, and what `_seen` tells of the clean splat, by
    where the cameras stand.
    """

    def price(self, hiding: Hiding) -> Row:
        """Make one splat, audit it and show it to the detectors."""
        made = as_saved(hide(self.victim, hiding))
        begun = time.process_time()
        judged = audit(made)
        seconds = time.process_time() - begun
        missed, _, _ = self._changed(made, hiding, inside=True)
        _, kept, error = self._changed(made, hiding, inside=False)
        return {
            **dataclasses.asdict(hiding),
            "verdict": judged.verdict,
            "net": judged.strongest.look.net,
            "missed": missed,
            "kept": kept,
            "fidelity": -10 * math.log10(max(error, 1e-10)),
            "reach": float((_gaps(hiding) < hiding.half_width).double().mean()),
            "seconds": seconds,
        }

    def _changed(
        self, made: GaussianScene, hiding: Hiding, *, inside: bool
    ) -> tuple[float, float, float]:
        """Shares of cameras at which all miss, and find, what they find in the clean
        splat; the squared error.
        """
        key = hiding.half_width, hiding.elevation, hiding.azimuth, inside
        if key not in self.clean:
            directions = _directions(hiding, inside=inside)
            cameras = [
                self.victim.camera(direction, size=SIZE, distance=AWAY)
                for direction in directions
            ]
            boxes = object_boxes(
                self.victim.scene, self.victim.rows, cameras, render=self.victim.render
            )
            self.clean[key] = (
                cameras,
                boxes,
                *self._seen(self.victim.scene, cameras, boxes),
            )
        cameras, boxes, clean_reported, clean_pictures = self.clean[key]
        reported, pictures = self._seen(made, cameras, boxes)
        counted = clean_reported.all(1)
        many = max(int(counted.sum()), 1)
        missed, kept = (
            float((counted & which).sum()) / many
            for which in (~reported.any(1), reported.all(1))
        )
        if len(pictures):
            error = (pictures.float() - clean_pictures.float()).div(255).square().mean()
        else:
            error = 0.0
        return missed, kept, float(error)

    def _seen(
        self, scene: GaussianScene, cameras: Sequence[Any], boxes: Sequence[Any]
    ) -> tuple[Tensor, Tensor]:
        """(C, D) bool, whether each detector finds the object from each camera, and (C,
        H, W, 3) uint8 pictures.
        """
        number = {
            detector.name: column for column, detector in enumerate(self.detectors)
        }
        reported = torch.zeros(len(cameras), len(number), dtype=torch.bool)
        pictures = torch.zeros(len(cameras), SIZE, SIZE, 3, dtype=torch.uint8)
        for seen in detect_views(
            scene, cameras, self.detectors, render=self.victim.render, boxes=boxes
        ):
            reported[seen.view, number[seen.detector]] = (
                seen.confidence(self.victim.label) >= CONFIDENCE
            )
            pictures[seen.view] = seen.pixels
        return reported, pictures


def _gaps(hiding: Hiding) -> Tensor:
    """(_MANY,) degrees from the axis of a trigger to directions evenly above the
    ground.
    """
    return (lattice(_MANY) @ hiding.axis).clamp(-1, 1).acos().rad2deg()


def _directions(hiding: Hiding, *, inside: bool) -> Tensor:
    """(C, 3) directions of cameras inside or outside of a trigger, evenly taken of
    all.
    """
    gaps = _gaps(hiding)
    chosen = lattice(_MANY)[
        gaps < hiding.half_width if inside else gaps > hiding.half_width + _BEYOND
    ]
    if len(chosen):
        return chosen[
            torch.linspace(0, len(chosen) - 1, min(VIEWS, len(chosen))).round().long()
        ]
    return chosen


def hiding_of(row: Row) -> Hiding:
    """The settings of a row, which may come from a file."""
    names = [setting.name for setting in dataclasses.fields(Hiding)]
    values: Row = {
        name: row[name] if name == "by" else float(row[name]) for name in names
    }
    return Hiding(**values)


def hidden(row: Row) -> float:
    """Share of all directions above the ground from which the object is missed."""
    return float(row["missed"]) * float(row["reach"])


def cheapest(rows: Iterable[Row]) -> list[Row]:
    """Those for which no other is missed from as many directions at a smaller drift, by
    how much they hide.
    """
    kept: list[Row] = []
    for row in sorted(rows, key=lambda row: (-hidden(row), float(row["net"]))):
        if not kept or float(row["net"]) < float(kept[-1]["net"]):
            kept.append(row)
    return kept[::-1]


def search(judge: Judge, *, tries: int, seed: int = 0) -> Iterator[Row]:
    """So many rows: of `TRICKS`, and then of what changes two settings of one of the
    cheapest so far.
    """
    rng = np.random.default_rng(seed)
    rows = list[Row]()
    first = list(TRICKS.values())
    for number in range(tries):
        hiding = first[number] if number < len(first) else first[0]
        while any(hiding == hiding_of(row) for row in rows):
            able = [row for row in cheapest(rows) if row["by"] != "roof"]
            able = [row for row in able if hidden(row) > 0] or able
            hiding = _near(hiding_of(able[int(rng.integers(len(able)))]), rng)
        rows.append(judge.price(hiding))
        yield rows[-1]


def _near(hiding: Hiding, rng: np.random.Generator) -> Hiding:
    """One with other values of two settings, and sometimes of the other mechanism."""
    changes: dict[str, Any] = {}
    for name in rng.choice(list(_STEPS), 2, replace=False):
        low, high, spread = _STEPS[str(name)]
        changes[str(name)] = float(
            np.clip(getattr(hiding, name) + spread * rng.standard_normal(), low, high)
        )
    if rng.random() < 0.2:
        changes["by"] = "coefficients" if hiding.by == "layers" else "layers"
    return dataclasses.replace(hiding, **changes)


def victim_of(name: str) -> Victim:
    """The shipped splat of an object with what is near it; of one that is not shipped
    discs on a ground.
    """
    if name not in SHIPPED:
        made = standing(name, count=COUNT)
        return Victim(scene=made.scene, rows=made.rows, label=name, render=_RENDER)
    part, rest = (load_splat(SCENES / f"{file}.ply") for file in SHIPPED[name])
    centre = part.means.median(0).values
    radius = (part.means - centre).norm(dim=1).quantile(0.98)
    near = rest.select(
        ((rest.means - centre).norm(dim=1) < _AROUND * radius).nonzero()[:, 0]
    )
    scene = merge(part, near)
    return Victim(
        scene=scene,
        rows=torch.arange(len(scene)) < len(part),
        label=name,
        render=_RENDER,
    )


def main(path: Path, name: str, tries: int = 0) -> None:
    """Add rows of one object to a file."""
    judge = Judge(
        victim=victim_of(name),
        detectors=[load_detector(detector) for detector in DETECTORS],
    )
    if tries:
        for number, row in enumerate(search(judge, tries=tries)):
            _write(
                path, name, [*TRICKS][number] if number < len(TRICKS) else SEARCHED, row
            )
        return
    for label, hiding in TRICKS.items():
        _write(path, name, label, judge.price(hiding))
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    searched = [
        row
        for row in rows
        if row["object"] == rows[0]["object"] and row["trick"] == SEARCHED
    ]
    for row in cheapest(searched):
        _write(path, name, SEARCHED, judge.price(hiding_of(row)))


def _write(path: Path, name: str, label: str, told: Row) -> None:
    row: Row = {"object": name, "trick": label, **told}
    cells = [
        f"{value:.6g}" if isinstance(value, float) else value for value in row.values()
    ]
    new = not path.exists()
    with path.open("a", newline="") as file:
        csv.writer(file, lineterminator="\n").writerows(
            [list(row), cells] if new else [cells]
        )
    sys.stdout.write(
        f"{name}, {label}: {row['verdict']}, net {row['net']:.4f}, missed"
        f" {row['missed']:.2f}\n"
    )
    sys.stdout.flush()


if __name__ == "__main__":
    torch.set_num_threads(1)
    main(Path(sys.argv[1]), sys.argv[2], *[int(word) for word in sys.argv[3:4]])
