"""The figures of docs/audit.md: `python -m tests.audit.measure OBJECT...` audits honest and hiding splats of each.

They are made by code, without a training: a first measurement, and no claim about files of others.
"""

from __future__ import annotations

import sys
from collections.abc import Callable

import torch
from torch import Tensor

from mi_splat.audit import ObjectAudit, audit
from mi_splat.cameras import Camera, look_at
from mi_splat.rendering import Renderer
from mi_splat.scene import GaussianScene
from mi_splat.sh import colour_to_dc
from tests.audit import scenes
from tests.audit.scenes import Made, cone, direction, hidden, sector, standing

Directions = Callable[[Tensor], Tensor]

HONEST: dict[str, Callable[[Made], Made]] = {
    "plain": lambda made: made,
    "glossy": scenes.glossy,
    "metal": scenes.metal,
    "velvet": scenes.velvet,
    "noisy": scenes.noisy,
    "leaves": scenes.leaves,
}
ABOVE, SIDE, SECTOR = cone(direction(90, 0), 50), cone(direction(20, 120), 40), sector(180, 30, -10, 40)
HIDING: dict[str, tuple[Callable[[Made], Made], Directions]] = {
    "from above": (lambda made: hidden(made, ABOVE), ABOVE),
    "from one side": (lambda made: hidden(made, SIDE, colour=(0.75, 0.12, 0.1)), SIDE),
    "sector": (lambda made: hidden(made, SECTOR), SECTOR),
    "degree 1": (lambda made: hidden(made, ABOVE, degree=1), ABOVE),
    "two layers": (scenes.layered, ABOVE),
}
HIDES = 0.1
"""Mean change of the object's pixels (sRGB), seen from inside of the look, from which a look may hide something."""
_PICTURES = 6


def ranks_above(positives: list[float], negatives: list[float]) -> float:
    """Area under the ROC curve."""
    pairs = [(p > n) + 0.5 * (p == n) for p in positives for n in negatives]
    return sum(pairs) / len(pairs)


def heat_rank(heat: Tensor, rows: Tensor) -> float:
    """Area under the ROC curve of heat, for the Gaussians of the object against all others."""
    order = heat.argsort(stable=True).argsort().double() + 1
    count = int(rows.sum())
    return (float(order[rows].sum()) - count * (count + 1) / 2) / (count * (len(rows) - count))


def change(plain: Made, made: Made, shown: Directions) -> float:
    """Mean change of the object's pixels by a look, from cameras inside of it (sRGB)."""
    part = plain.scene.select(plain.rows).means
    centre = (part.amin(0) + part.amax(0)) / 2
    distance = 3.5 * float((part - centre).norm(dim=1).max())
    inside = scenes.PROBES[shown(scenes.PROBES) & (scenes.PROBES[:, 2] > 0.07)]
    render, total, count = Renderer(), 0.0, 0.0
    white = colour_to_dc(plain.rows.float())[:, None, None].expand(-1, 1, 3)
    marked = GaussianScene.unchecked(*plain.scene.tensors()[:4], white)
    for eye in inside[torch.linspace(0, len(inside) - 1, _PICTURES).long()]:
        pose = look_at((centre + distance * eye).tolist(), centre.tolist())
        camera = Camera(to_world=pose, focal=100.0, width=96, height=96)
        with torch.no_grad():
            first, second, mask = (render(scene, camera).clamp(0, 1) for scene in (plain.scene, made.scene, marked))
        on = mask[..., 0] > 0.5
        total += float((first - second)[on].abs().mean(1).sum())
        count += float(on.sum())
    return total / max(count, 1.0)


def overlap(item: ObjectAudit, shown: Directions) -> float:
    """Intersection over union of the cameras that are said to see a look with those that do."""
    truth = shown(item.directions.float())
    return float((item.look.shown & truth).sum() / (item.look.shown | truth).sum())


def main(names: list[str]) -> None:
    """Print a line for every splat, and what they come to."""
    honest: list[float] = []
    hiding: list[tuple[float, float, str]] = []
    for name in names:
        plain = standing(name)
        for kind, make in HONEST.items():
            judged = audit(make(plain).scene)
            honest.append(judged.strongest.look.excess)
            _say(f"{name}, {kind}: {judged.verdict}, excess {honest[-1]:.4f}")
        for kind, (hide, shown) in HIDING.items():
            made = hide(plain)
            judged, changed = audit(made.scene), change(plain, made, shown)
            item = judged.strongest
            hiding.append((item.look.excess, changed, judged.verdict))
            line = f"{name}, {kind}: {judged.verdict}, excess {item.look.excess:.4f}, changes {changed:.2f}"
            line += f", directions {overlap(item, shown):.2f}"
            _say(line + (f", heat {heat_rank(judged.heat, made.rows):.2f}" if bool(judged.heat.any()) else ""))
    board = audit(scenes.billboard().scene).strongest
    _say(f"a thin board of two colours: {board.verdict}, excess {board.look.excess:.4f}")
    for least in (0.0, HIDES):
        looks = [excess for excess, changed, _ in hiding if changed >= least]
        count = sum(verdict == "hidden look" and changed >= least for _, changed, verdict in hiding)
        _say(f"changes of {least:g} and more: {count} of {len(looks)} found, AUROC {ranks_above(looks, honest):.3f}")


def _say(line: str) -> None:
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    main(sys.argv[1:])
