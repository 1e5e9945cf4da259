"""What hiding from the audit costs: `python -m tests.audit.measure_price FILE.csv OBJECT [TRIES]`.

With TRIES the attacker searches on the object; without, all that he would try first and what is cheapest in FILE is
reported on it. Rows are added to FILE; `docs/figures/audit_price.py` draws it.
"""

import csv
import sys
import typing
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import torch

from attacks.audits.hiding import Hiding, Victim
from attacks.audits.price import TRICKS, Judge, Price, cheapest, search
from attacks.detectors.registry import load_detector
from mi_splat.io import load_splat
from mi_splat.rendering import Renderer, RenderSettings
from mi_splat.scene import merge
from tests.audit.scenes import standing

SCENES = Path(__file__).parents[2] / "scenes"
SHIPPED = {"car": ("car_street_car", "car_street_street"), "stop sign": ("stop_sign_stop_sign", "stop_sign_roadside")}
"""Object to the files of it and of what is around it."""
DETECTORS = ("fasterrcnn_small",)
COUNT = 1200
"""Discs of an object that is not shipped."""
SEARCHED = "searched"
_AROUND = 2.4
"""Radii of a shipped object around it within which its surroundings are kept: enough for a ground, and quicker."""
_RENDER = Renderer(RenderSettings(background=(0.55, 0.7, 0.9)))


def victim_of(name: str) -> Victim:
    """The shipped splat of an object with what is near it; of one that is not shipped discs on a ground."""
    if name not in SHIPPED:
        made = standing(name, count=COUNT)
        return Victim(scene=made.scene, rows=made.rows, label=name, render=_RENDER)
    part, rest = (load_splat(SCENES / f"{file}.ply") for file in SHIPPED[name])
    centre = part.means.median(0).values
    radius = (part.means - centre).norm(dim=1).quantile(0.98)
    near = rest.select(((rest.means - centre).norm(dim=1) < _AROUND * radius).nonzero()[:, 0])
    scene = merge(part, near)
    return Victim(scene=scene, rows=torch.arange(len(scene)) < len(part), label=name, render=_RENDER)


def main(path: Path, name: str, tries: int = 0) -> None:
    """Add rows of one object to a file."""
    judge = Judge(victim=victim_of(name), detectors=[load_detector(detector) for detector in DETECTORS])
    if tries:
        names = list(TRICKS)
        for number, point in enumerate(search(judge, tries=tries)):
            _write(path, name, names[number] if number < len(names) else SEARCHED, point)
        return
    for label, hiding in TRICKS.items():
        _write(path, name, label, judge.price(hiding))
    for hiding in cheapest_of(path):
        _write(path, name, SEARCHED, judge.price(hiding))


def cheapest_of(path: Path) -> list[Hiding]:
    """What the search found on the first object of a file that nothing there beats."""
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    points = [_price_of(row) for row in rows if row["object"] == rows[0]["object"] and row["trick"] == SEARCHED]
    return [point.hiding for point in cheapest(points)]


def _price_of(row: Mapping[str, str]) -> Price:
    texts = ("by", "verdict")
    hiding, told = (
        {key: row[key] if key in texts else float(row[key]) for key in typing.get_type_hints(kind) if key != "hiding"}
        for kind in (Hiding, Price)
    )
    settings: dict[str, Any] = hiding
    values: dict[str, Any] = told
    return Price(hiding=Hiding(**settings), **values)


def _write(path: Path, name: str, label: str, point: Price) -> None:
    row: dict[str, Any] = {"object": name, "trick": label, **point.row()}
    cells: Iterable[Any] = (f"{value:.6g}" if isinstance(value, float) else value for value in row.values())
    new = not path.exists()
    with path.open("a", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerows([list(row), list(cells)] if new else [list(cells)])
    sys.stdout.write(f"{name}, {label}: {point.verdict}, excess {point.excess:.4f}, missed {point.missed:.2f}\n")
    sys.stdout.flush()


if __name__ == "__main__":
    torch.set_num_threads(1)
    main(Path(sys.argv[1]), sys.argv[2], *[int(word) for word in sys.argv[3:4]])
