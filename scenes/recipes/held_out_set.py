"""How often held-out directions are right: `python -m scenes.recipes.held_out_set
FOLDER FILE.csv`.

Makes a random set that no threshold was chosen on (see `drawn` in
`scenes.recipes.audit_set`), and adds a row to FILE.csv for each splat that has none.
"""

import csv
import json
import sys
import time
from dataclasses import asdict, dataclass
from pathlib import Path

from attacks.audits.recognition import Recognition
from mi_splat.audit.held_out import HeldOut, held_out
from mi_splat.io import load_splat
from scenes.recipes.audit_set import drawn, made, ranked, read

NUMBERS = (2000, 2018)
"""First and last (excluded) number of the random set."""


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


def row_of(name: str, found: HeldOut, strength: float | str, seconds: float) -> Row:
    """The row of a splat."""
    known = [one or "-" for one in found.known_as]
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


def main(folder: str, file: str) -> None:
    """Make the set, and judge what has no row."""
    target = Path(file)
    known = {row["file"] for row in read(target)} if target.is_file() else set()
    recogniser = Recognition()
    items = dict(drawn(*NUMBERS))
    made(Path(folder), items.items())
    for name in items:
        if name in known:
            continue
        path = Path(folder) / f"{name}.ply"
        begun = time.process_time()
        found = held_out(load_splat(path), recogniser)
        seconds = time.process_time() - begun
        about = json.loads(path.with_suffix(".json").read_text())
        row = asdict(row_of(name, found, about.get("strength", ""), seconds))
        is_new = not target.is_file()
        with target.open("a", newline="") as stream:
            writer = csv.DictWriter(stream, row, lineterminator="\n")
            if is_new:
                writer.writeheader()
            writer.writerow(row)
    area, low, high = ranked(read(target))
    sys.stdout.write(f"AUROC {area:.3f} ({low:.3f} to {high:.3f})\n")


if __name__ == "__main__":
    main(*sys.argv[1:])
