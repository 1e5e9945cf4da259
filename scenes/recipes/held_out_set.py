"""How often the audit is right: `python -m scenes.recipes.held_out_set SET FOLDER
FILE.csv`.

Makes what is missing of a set (see `SETS`), and adds a row to FILE.csv for each splat
that has none. The set `meshes` is that of the GLB files in FOLDER/meshes.
"""

import csv
import json
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path

from attacks.audits.recognition import Recognition
from mi_splat.audit import Audit, audit
from mi_splat.io import load_splat
from scenes.recipes.audit_set import (
    Item,
    attackers,
    drawn,
    hides,
    honest,
    made,
    meshes,
    ranked,
    read,
    strength,
)

SETS: dict[str, Callable[[], Iterator[tuple[str, Item]]]] = {
    "random": partial(drawn, 2000, 2018),
    "second": partial(drawn, 2018, 2063),
    "third": partial(drawn, 2063, 2108),
    "strength": strength,
    "attackers": attackers,
}
"""Sets by name; nothing was chosen on the third one."""


@dataclass(frozen=True, kw_only=True)
class Row:
    """What held-out directions say of a splat."""

    file: str
    answer: str
    evidence: float  # departure towards the other views, by which files are ranked
    distance: float  # largest cosine distance of features
    gain: float  # largest gain of confidence
    known_as: str
    strength: float | str  # of a trained poisoning; below 0.4 it counts on neither side
    seconds: float  # of one thread


def row_of(name: str, found: Audit, strength: float | str, seconds: float) -> Row:
    """The row of a splat."""
    known = [item.known_as or "-" for item in found.objects]
    return Row(
        file=name,
        answer=found.answer,
        evidence=round(found.evidence, 4),
        distance=round(max(view.distance for view in found.views), 4),
        gain=round(max(view.gain for view in found.views), 4),
        known_as=" ".join(known),
        strength=strength,
        seconds=round(seconds, 1),
    )


def main(name: str, folder: str, file: str) -> None:
    """Make the set, and judge what has no row."""
    target = Path(file)
    known = {row["file"] for row in read(target)} if target.is_file() else set()
    recogniser = Recognition()
    items = meshes(Path(folder) / name) if name == "meshes" else SETS[name]()
    for splat, item in items:
        if splat in known:
            continue
        made(Path(folder), [(splat, item)])
        path = Path(folder) / f"{splat}.ply"
        begun = time.process_time()
        found = audit(load_splat(path), recogniser)
        seconds = time.process_time() - begun
        about = json.loads(path.with_suffix(".json").read_text())
        row = asdict(row_of(splat, found, about.get("strength", ""), seconds))
        is_new = not target.is_file()
        with target.open("a", newline="") as stream:
            writer = csv.DictWriter(stream, row, lineterminator="\n")
            if is_new:
                writer.writeheader()
            writer.writerow(row)
    rows = read(target)
    if any(map(honest, rows)) and any(map(hides, rows)):
        area, low, high = ranked(rows)
        sys.stdout.write(f"AUROC {area:.3f} ({low:.3f} to {high:.3f})\n")


if __name__ == "__main__":
    main(*sys.argv[1:])
