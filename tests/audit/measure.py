"""The figures of docs/audit.md: `python -m tests.audit.measure OBJECT...` audits honest and hiding splats of each.

They are made by code, without a training: a first measurement, and no claim about files of others.
"""

from __future__ import annotations

import sys
from collections.abc import Callable

import torch

from mi_splat.audit import audit
from tests.audit import scenes
from tests.audit.scenes import Made, cone, direction, hidden, sector, standing

HONEST: dict[str, Callable[[Made], Made]] = {
    "plain": lambda made: made,
    "glossy": scenes.glossy,
    "metal": scenes.metal,
    "velvet": scenes.velvet,
    "noisy": scenes.noisy,
    "leaves": scenes.leaves,
}
HIDING: dict[str, Callable[[Made], Made]] = {
    "from above": lambda made: hidden(made, cone(direction(90, 0), 50)),
    "from one side": lambda made: hidden(made, cone(direction(20, 120), 40), colour=(0.75, 0.12, 0.1)),
    "sector": lambda made: hidden(made, sector(180, 30, -10, 40)),
    "degree 1": lambda made: hidden(made, cone(direction(90, 0), 50), degree=1),
    "two layers": scenes.layered,
}


def ranks_above(positives: list[float], negatives: list[float]) -> float:
    """Area under the ROC curve."""
    pairs = [(p > n) + 0.5 * (p == n) for p in positives for n in negatives]
    return sum(pairs) / len(pairs)


def heat_rank(heat: torch.Tensor, rows: torch.Tensor) -> float:
    """Area under the ROC curve of heat, for the Gaussians of the object against all others."""
    order = heat.argsort(stable=True).argsort().double() + 1
    count = int(rows.sum())
    return (float(order[rows].sum()) - count * (count + 1) / 2) / (count * (len(rows) - count))


def main(names: list[str]) -> None:
    """Print a line for every splat, and what they come to."""
    excess: dict[bool, list[float]] = {True: [], False: []}
    for name in names:
        plain = standing(name)
        for hides, kinds in ((False, HONEST), (True, HIDING)):
            for kind, make in kinds.items():
                made = make(plain)
                judged = audit(made.scene)
                item = judged.strongest
                excess[hides].append(item.look.excess)
                line = f"{name}, {kind}: {judged.verdict}, excess {item.look.excess:.4f}"
                if hides and bool(judged.heat.any()):
                    line += f", heat AUROC {heat_rank(judged.heat, made.rows):.2f}"
                sys.stdout.write(line + "\n")
                sys.stdout.flush()
    board = audit(scenes.billboard().scene).strongest
    sys.stdout.write(f"a thin board of two colours: {board.verdict}, excess {board.look.excess:.4f}\n")
    sys.stdout.write(f"AUROC of the excess: {ranks_above(excess[True], excess[False]):.3f}, ")
    sys.stdout.write(f"{len(excess[True])} hide, {len(excess[False])} are honest\n")


if __name__ == "__main__":
    main(sys.argv[1:])
