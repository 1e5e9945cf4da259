"""How baselines tell hidden looks from honest splats: `python -m tests.audit.measure_baselines [LIST]`.

LIST has a line for each splat: its path, its object, its kind and whether it `hides` or is `honest`, parted by tabs.
Without it, splats are made by code as in `tests.audit.measure`. The classifier is trained on one kind of attack and on
one half of the objects, and tested on the others.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from attacks.audits.baselines import measured
from attacks.audits.learnt import attributes, fit_attributes
from mi_splat.audit import audit
from mi_splat.scene import GaussianScene
from mi_splat.scene_files import open_scene
from tests.audit.measure import HIDING, HONEST, ranks_above
from tests.audit.scenes import standing

OBJECTS, COUNT = ("car", "suitcase", "elephant", "bird"), 1000
"""Of splats made by code: objects, and their discs."""
AUDIT, LEARNT = "audit", "attributes, learnt"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Measured:
    """One splat: what it is, its score by each baseline, and its attributes."""

    content: str
    kind: str
    hides: bool
    scores: dict[str, tuple[float, float]]
    attributes: Tensor


def made() -> Iterator[tuple[str, str, bool, GaussianScene]]:
    """Object, kind, whether it hides something, and splat, of those made by code."""
    for name in OBJECTS:
        plain = standing(name, count=COUNT)
        for kind, make in HONEST.items():
            yield name, kind, False, make(plain).scene
        for kind, (hide, _) in HIDING.items():
            yield name, kind, True, hide(plain).scene


def listed(path: Path) -> Iterator[tuple[str, str, bool, GaussianScene]]:
    """The same of a list."""
    for line in path.read_text().splitlines():
        file, name, kind, label = line.split("\t")
        if label.split()[0] in ("hides", "honest"):
            yield name, kind.split(":")[0], label.startswith("hides"), open_scene(Path(file)).scene


def measure(splats: Iterator[tuple[str, str, bool, GaussianScene]]) -> list[Measured]:
    """Every splat by every baseline and by the audit."""
    done = []
    for content, kind, hides, scene in splats:
        begun = time.process_time()
        evidence = audit(scene).strongest.evidence
        scores = {AUDIT: (evidence, time.process_time() - begun)} | measured(scene)
        row = Measured(content=content, kind=kind, hides=hides, scores=scores, attributes=attributes(scene))
        done.append(row)
        _say(f"{content}, {kind}: " + ", ".join(f"{name} {score:.4f}" for name, (score, _) in scores.items()))
    return done


def learnt(rows: Sequence[Measured]) -> Iterator[tuple[str, float]]:
    """Kind of attack trained on, and how hiding splats of other kinds and objects rank above honest ones of these."""
    contents = list(dict.fromkeys(row.content for row in rows))
    half = set(contents[: (len(contents) + 1) // 2])
    for kind in dict.fromkeys(row.kind for row in rows if row.hides):
        train = [row for row in rows if row.content in half and (row.kind == kind or not row.hides)]
        other = [row for row in rows if row.content not in half and (row.kind != kind or not row.hides)]
        if len({row.hides for row in train}) < 2 or len({row.hides for row in other}) < 2:
            continue
        trained = fit_attributes(torch.stack([row.attributes for row in train]), [row.hides for row in train])
        odds = trained.odds(torch.stack([row.attributes for row in other])).tolist()
        yield (
            kind,
            ranks_above(*([v for v, row in zip(odds, other, strict=True) if row.hides is w] for w in (True, False))),
        )


def main(path: Path | None = None) -> None:
    """Print a table."""
    rows = measure(made() if path is None else listed(path))
    _say("| way | ranks a hiding splat above an honest one | CPU seconds a splat |\n|---|---|---|")
    for name in rows[0].scores:
        hiding, honest = ([row.scores[name][0] for row in rows if row.hides is which] for which in (True, False))
        seconds = sum(row.scores[name][1] for row in rows) / len(rows)
        _say(f"| {name} | {ranks_above(hiding, honest):.3f} | {seconds:.2f} |")
    for kind, rank in learnt(rows):
        _say(f"| {LEARNT} on '{kind}', other kinds and objects | {rank:.3f} | |")


def _say(line: str) -> None:
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    torch.set_num_threads(1)
    main(*[Path(word) for word in sys.argv[1:2]])
