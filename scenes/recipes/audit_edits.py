"""Figures of edits in docs/audit-measured.md:
`python -m scenes.recipes.audit_edits CLEAN [ATTACKED...]`.

Prints the score of each object of a clean file, of files that `mi-splat dagger` made of
it, and of edits made by code of the largest object: random noise, another colour, a
sticker, and a part taken away.
"""

import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import torch
from torch import Tensor

from mi_splat.audit.evidence import edit_of
from mi_splat.audit.objects import frame_of, targets
from mi_splat.render.scene_files import open_scene
from mi_splat.scene import GaussianScene


def noise(size: float) -> Callable[[GaussianScene, Tensor], GaussianScene]:
    """Chance in all coefficients."""

    def edit(scene: GaussianScene, rows: Tensor) -> GaussianScene:
        sh = scene.sh.clone()
        sh[rows] += size * torch.randn(
            sh[rows].shape, generator=torch.Generator().manual_seed(0)
        )
        return scene.replace(sh=sh)

    return edit


def graded(scene: GaussianScene, rows: Tensor) -> GaussianScene:
    """More red and less blue."""
    sh = scene.sh.clone()
    sh[rows] *= torch.tensor([1.3, 1.0, 0.7])
    return scene.replace(sh=sh)


def sticker(scene: GaussianScene, rows: Tensor) -> GaussianScene:
    """A tenth of it is green, around its first Gaussian."""
    sh = scene.sh.clone()
    gaps = (scene.means[rows] - scene.means[rows[0]]).norm(dim=1)
    sh[rows[gaps.argsort()[: len(rows) // 10]], 0] = torch.tensor([-1.0, 0.8, -0.5])
    return scene.replace(sh=sh)


def pruned(scene: GaussianScene, rows: Tensor) -> GaussianScene:
    """Without a third of it."""
    kept = torch.ones(len(scene), dtype=torch.bool)
    kept[rows[::3]] = False
    return scene.select(kept)


EDITS: dict[str, Callable[[GaussianScene, Tensor], GaussianScene]] = {
    "noise 0.02": noise(0.02),
    "noise 0.05": noise(0.05),
    "noise 0.2": noise(0.2),
    "graded": graded,
    "sticker": sticker,
    "pruned": pruned,
}


def scores(name: str, scene: GaussianScene) -> Iterator[tuple[str, Tensor]]:
    """A line and the rows of each object."""
    frame = frame_of(scene)
    for number, target in enumerate(targets(frame.scene), 1):
        edit = edit_of(frame, target)
        if edit is not None:
            if edit.camera_known:
                where = " ".join(f"{value:.2f}" for value in edit.direction)
            else:
                where = "no camera"
            numbers = (
                f"aimed {edit.aimed:.3f}, grain {edit.grain - edit.usual_grain:.3f}"
            )
            yield (
                f"{name}, object {number}: {edit.score:.2f} ({numbers}; {where})",
                frame.order[target.rows],
            )


def main(names: list[str]) -> None:
    """Print a line for every object of every splat."""
    clean = open_scene(Path(names[0])).scene
    scored = list(scores(names[0], clean))
    lines = [line for line, _ in scored]
    for name in names[1:]:
        lines += [line for line, _ in scores(name, open_scene(Path(name)).scene)]
    for name, edit in EDITS.items():
        lines += [line for line, _ in scores(name, edit(clean, scored[0][1]))]
    sys.stdout.write("\n".join(lines) + "\n")


if __name__ == "__main__":
    main(sys.argv[1:])
