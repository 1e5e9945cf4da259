"""`mi-splat info`: what a splat file or a scene XML holds."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from pathlib import Path

from torch import Tensor

from mi_splat.cli.console import progress, show_json, show_table
from mi_splat.cli.options import InfoOptions
from mi_splat.io import SplatFileWarning, load_splat
from mi_splat.scene import GaussianScene, scene_hash
from mi_splat.sh import colours_by_direction, even_directions

QUANTILES = (0.0, 0.05, 0.5, 0.95, 1.0)


def run(options: InfoOptions) -> int:
    """Print the facts about a file."""
    with progress(f"reading {options.file}"):
        facts = _scene_file_facts(options.file) if options.file.suffix.lower() == ".xml" else _splat_facts(options.file)
    if options.json:
        show_json({"file": str(options.file), **facts})
    else:
        show_table([("file", str(options.file)), *((name, _text(value)) for name, value in facts.items())])
    return 0


def _splat_facts(path: Path) -> dict[str, object]:
    """Facts about a splat file, which has no parts; Gaussians that are not valid are described and left out."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", SplatFileWarning)
        scene = load_splat(path, on_invalid="drop")
    dropped = [str(item.message) for item in caught if issubclass(item.category, SplatFileWarning)]
    return {"parts": None, **scene_facts(scene), "invalid": " ".join(dropped) or None}


def _scene_file_facts(path: Path) -> dict[str, object]:
    """Facts about a scene XML: its parts, its cameras, and all its Gaussians together."""
    from mi_splat.scene_files import read_scene

    loaded = read_scene(path)
    parts = {name: len(range(*rows.indices(len(loaded.scene)))) for name, rows in loaded.objects.items()}
    cameras = {name: f"{camera.width} x {camera.height}" for name, camera in loaded.cameras.items()}
    boxes = {name: _bounds(loaded.scene.select(rows)) for name, rows in loaded.objects.items() if parts[name]}
    return {"parts": parts, "part_bounds": boxes, "cameras": cameras, **scene_facts(loaded.scene)}


def scene_facts(scene: GaussianScene) -> dict[str, object]:
    """Numbers that describe a scene, as JSON can hold them; bounds and scales in world units.

    Of a captured scene `bounds` are those of the farthest floaters; `box`, of the middle 98 % along each axis, tells
    where the scene is, and `middle`, the median, where most of it is: often the object. Half of the Gaussians are
    within `reach` of it. `colour` is the mean colour of the Gaussians (1 is white) in the directions in which it is
    least and most, and the largest of any Gaussian in any direction: where these are far apart, the splat was not made
    of what cameras saw alone.
    """
    facts: dict[str, object] = {"gaussians": len(scene), "sh_degree": scene.degree}
    if len(scene):
        facts["bounds"] = _bounds(scene)
        facts["box"] = _bounds(scene, outside=0.01)
        middle = scene.means.median(dim=0).values
        facts["middle"] = middle.tolist()
        facts["reach"] = float((scene.means - middle).norm(dim=1).median())
        facts["opacity"] = _quantiles(scene.opacities)
        facts["scale"] = _quantiles(scene.scales.flatten())
        facts["colour"] = _colours(scene)
    return {**facts, "hash": scene_hash(scene)}


def _bounds(scene: GaussianScene, *, outside: float = 0.0) -> list[list[float]]:
    """Lower and upper corner of the box around the means, without so large a share at either end of each axis."""
    ordered = scene.means.sort(dim=0).values
    last = len(ordered) - 1
    return [ordered[round(share * last)].tolist() for share in (outside, 1 - outside)]


def _quantiles(values: Tensor) -> dict[str, float]:
    """Minimum, 5 %, median, 95 % and maximum (torch.quantile takes no more than 16 million values)."""
    ordered = values.sort().values
    rows = [round(q * (len(ordered) - 1)) for q in QUANTILES]
    return {f"{q:.0%}": float(ordered[row]) for q, row in zip(QUANTILES, rows, strict=True)}


def _colours(scene: GaussianScene) -> dict[str, float]:
    """How bright the Gaussians are over all directions."""
    means, most = colours_by_direction(scene.sh, even_directions())
    return {"least mean": float(means.min()), "most mean": float(means.max()), "largest": float(most.max())}


def _text(value: object) -> str:
    """One fact for a human."""
    if isinstance(value, Mapping):
        return ", ".join(f"{name}: {_text(part)}" for name, part in value.items())
    if isinstance(value, list):
        first, *rest = value
        if isinstance(first, list):
            return " to ".join(_text(part) for part in value)
        return "(" + ", ".join(_text(part) for part in (first, *rest)) + ")"
    if isinstance(value, float):
        return f"{value:.4g}"
    return f"{value:,}" if isinstance(value, int) else "none" if value is None else str(value)
