"""What a converter has kept of the splats of the pack, for `conform --read`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from scipy.optimize import linear_sum_assignment

from mi_splat.cli.conform_pack import Scenes, load, through_file
from mi_splat.cli.convert import differences
from mi_splat.conformance.scenes import ConformanceScene
from mi_splat.errors import InvalidValueError
from mi_splat.io.errors import SplatFileError
from mi_splat.io.splat_files import suffix_of
from mi_splat.scene import GaussianScene

_CHANGE = 2e-4
"""Largest change of a value in a converted file, besides three times that by which our
writer of the format rounds.
"""


def compare_files(folder: Path, scenes: Scenes) -> list[dict[str, Any]]:
    """Compare the values of converted files with those of the PLY, and with what our
    writer rounds of them.

    Returns:
        For each file its name, whether it conforms, its changes and their text.
    """
    rows = [
        _row(scene, path)
        for name, scene in scenes.items()
        for path in sorted(folder.glob(f"{name}.*"))
        if suffix_of(path.name)
    ]
    if not rows:
        raise InvalidValueError.of(
            str(folder),
            f"files such as {next(iter(scenes))}.spz",
            "none",
            "convert what mi-splat conform --export writes",
        )
    return rows


def _row(scene: ConformanceScene, path: Path) -> dict[str, Any]:
    row: dict[str, Any] = {"name": scene.name, "file": str(path), "conforms": False}
    before = through_file(scene, ".ply")
    try:
        after = load(path)
    except SplatFileError as problem:
        return row | {"unreadable": str(problem), "text": f"unreadable: {problem}"}
    row |= {"gaussians": [len(before), len(after)]}
    if len(before) != len(after):
        text = f"expected {len(before)} Gaussians, got {len(after)}"
        return row | {"text": text}
    changes = differences(before, after.select(_nearest(before, after)))
    rounding = differences(before, through_file(scene, suffix_of(path.name) or ""))
    # A ratio that has not changed is 1, and any other change 0.
    limits = {
        key: 3 * value - 2 * key.endswith("ratio") + _CHANGE
        for key, value in rounding.items()
    }
    good = all(value <= limits.get(key, _CHANGE) for key, value in changes.items())
    words = [f"{key.partition(',')[0]} {value:.2g}" for key, value in changes.items()]
    return row | {
        "conforms": good,
        "largest_changes": changes,
        "rounding": rounding,
        "text": ", ".join(words),
    }


def _nearest(before: GaussianScene, after: GaussianScene) -> torch.Tensor:
    """Of each Gaussian the row of its partner, since some formats sort them."""
    first, second = (
        torch.cat([s.means, s.scales, s.opacities[:, None], s.sh[:, 0]], dim=1)
        for s in (before, after)
    )
    distances = torch.cdist(first, second).numpy()
    return torch.from_numpy(linear_sum_assignment(distances)[1])
