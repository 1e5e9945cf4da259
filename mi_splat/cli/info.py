"""`mi-splat info`: what a splat file, a scene XML or a set of photographs holds; of a
PLY it is told without torch, and so at once.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mi_splat.attributes import ATTRIBUTES, values_hash
from mi_splat.cli.console import (
    UsageError,
    import_at_once,
    progress,
    show_json,
    show_table,
)
from mi_splat.cli.flags import Positional
from mi_splat.cli.options import Direction, JsonOptions, Point, up_line
from mi_splat.io.errors import SplatFileWarning
from mi_splat.selection.config import Selection

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from mi_splat.io.loaded import Arrays


EXAMPLES = (
    "info YOUR.ply",
    "info scenes/car_street.xml --json",
    "info YOUR_SET --splat YOUR.ply --mask mask.npy",
)


@dataclass(frozen=True, kw_only=True)
class InfoOptions(JsonOptions):
    """Print the contents of a splat file, a scene XML or a set of photographs.

    For a set it prints the number of photographs, how many of them have a camera, the
    up direction, and the azimuth, elevation and distance of each camera around
    --centre, as `mi-splat poison --hide-from` and `mi-splat evaluate --inside` take
    them.
    """

    file: Positional[Path]
    """Splat file of any format that is read, scene XML made of splats, or the folder of
    a set of photographs with cameras (COLMAP or transforms).
    """
    centre: Point | None = None
    """For a set: the point from which directions are measured. Default: the point that
    its cameras face.
    """
    up: Direction | None = None
    """For a set: the up direction, an axis or X,Y,Z. Default: estimated from its
    cameras.
    """
    splat: Path | None = None
    """For a set: a splat trained on it; directions are measured from the centre of its
    object.
    """
    selection: Selection = field(default_factory=Selection)
    """The object of the splat."""


QUANTILES = (0.0, 0.05, 0.5, 0.95, 1.0)


def run(options: InfoOptions) -> None:
    """Print the facts about a file."""
    from mi_splat.io.folders import splat_in

    if _is_set(options.file):
        _show_set(options)
        return
    _check_of_splat(options)
    with progress(f"reading {options.file}"):
        if options.file.suffix.lower() == ".xml":
            read = _scene_file_facts
        else:
            read = _file_facts
        facts = read(options.file)
    file = str(splat_in(options.file) or options.file)
    if options.json:
        show_json({"file": file, **facts})
    else:
        show_table(
            [("file", file), *((name, _text(value)) for name, value in facts.items())]
        )


def _is_set(path: Path) -> bool:
    """Whether a path is a set of photographs; nothing is imported for other files."""
    from mi_splat.io.folders import splat_in

    if path.suffix.lower() != ".json" and not path.is_dir():
        return False
    if path.is_dir() and splat_in(path) is not None:
        return False
    from mi_splat.datasets import is_dataset

    return is_dataset(path)


def _show_set(options: InfoOptions) -> None:
    from mi_splat.cli.set_facts import document_of, facts_of, show_facts

    with progress(f"reading {options.file}"):
        facts = facts_of(options)
    if options.json:
        show_json(document_of(options.file, facts))
    else:
        show_facts(options.file, facts)


def _check_of_splat(options: InfoOptions) -> None:
    """Raise if a flag was given that means nothing for a splat."""
    given = {
        "--centre": options.centre,
        "--up": options.up,
        "--splat": options.splat,
        "an object": None if options.selection.is_empty else "one",
    }
    for flag, value in given.items():
        if value is not None:
            got = f"{options.file}, which is no set"
            raise UsageError.of(flag, "a set of photographs", got, "leave it out")


def _file_facts(path: Path) -> dict[str, object]:
    """Facts about a splat file, which has no parts; Gaussians that are not valid are
    described and left out.
    """
    from mi_splat.io.loaded import ranges
    from mi_splat.io.splat_files import load_stored
    from mi_splat.io.up_axis import up_axis

    stored = load_stored(path)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", SplatFileWarning)
        splat = stored.settle(str(path), "drop", stacklevel=1).arrays
    notes = [
        str(item.message)
        for item in caught
        if issubclass(item.category, SplatFileWarning)
    ]
    facts: dict[str, object] = {"parts": None, **splat_facts(splat)}
    digest = facts.pop("hash")
    facts["up"] = up_line(up_axis(path, stored)).removeprefix("up is taken as ")
    facts["hash"] = digest
    facts["mode"] = "antialiased" if stored.is_antialiased else "default"
    return {
        **facts,
        "unread": ", ".join(ranges(stored.unread)) or None,
        "notes": " ".join(notes) or None,
    }


def _scene_file_facts(path: Path) -> dict[str, object]:
    import_at_once("torch")
    from mi_splat.render.scene_files import read_scene

    loaded = read_scene(path)
    parts = {
        name: len(range(*rows.indices(len(loaded.scene))))
        for name, rows in loaded.objects.items()
    }
    cameras = {
        name: f"{camera.width} x {camera.height}"
        for name, camera in loaded.cameras.items()
    }
    splat: Arrays = {
        name: value.numpy()
        for name, value in zip(ATTRIBUTES, loaded.scene.tensors(), strict=True)
    }
    boxes = {
        name: _at(splat["means"][rows], (0.0, 1.0))
        for name, rows in loaded.objects.items()
        if parts[name]
    }
    return {
        "parts": parts,
        "part_bounds": boxes,
        "cameras": cameras,
        **splat_facts(splat),
    }


def splat_facts(splat: Arrays) -> dict[str, object]:
    """Numbers that describe a splat, as JSON can hold them; bounds and scales in world
    units.

    Of a captured scene `bounds` are those of the farthest floaters; `box`, of the
    middle 98 % along each axis, tells where the scene is, and `middle`, the median,
    where most of it is: often the object. Half of the Gaussians are within `reach` of
    it. `colour` is the mean colour of the Gaussians (1 is white) in the directions in
    which it is least and most, and the largest of any Gaussian in any direction: where
    these are far apart, the splat was not made of what cameras saw alone.
    """
    import numpy as np

    from mi_splat.maths.sh import degree_of

    means = splat["means"]
    facts: dict[str, object] = {
        "gaussians": len(means),
        "sh_degree": degree_of(splat["sh"].shape[1]),
    }
    if len(means):
        facts["bounds"] = _at(means, (0.0, 1.0))
        facts["box"] = _at(means, (0.01, 0.99))
        (middle,) = _at(means, (0.5,))
        distances = np.linalg.norm(means.astype(np.float64) - middle, axis=1)
        facts |= {"middle": middle, "reach": _at(distances, (0.5,))[0]}
        for name, values in (
            ("opacity", splat["opacities"]),
            ("scale", splat["scales"].ravel()),
        ):
            facts[name] = dict(
                zip(
                    (f"{share:.0%}" for share in QUANTILES),
                    _at(values, QUANTILES),
                    strict=True,
                )
            )
        facts["colour"] = _colours(splat["sh"])
    return {**facts, "hash": values_hash(splat)}


def _at(values: NDArray[np.floating[Any]], shares: Sequence[float]) -> list[Any]:
    """The values, of each column, below which such a share of them lies; each is one of
    them.
    """
    import numpy as np

    ordered = np.sort(values, axis=0)
    return [ordered[round(share * (len(ordered) - 1))].tolist() for share in shares]


def _colours(sh: NDArray[np.float32]) -> dict[str, float]:
    from mi_splat.maths.sh import colours_by_direction, even_directions

    means, most = colours_by_direction(sh, even_directions())
    return {
        "least mean": float(means.min()),
        "most mean": float(means.max()),
        "largest": float(most.max()),
    }


def _text(value: object) -> str:
    if isinstance(value, Mapping):
        return ", ".join(f"{name}: {_text(part)}" for name, part in value.items())
    if isinstance(value, list):
        texts = list(map(_text, value))
        if isinstance(value[0], list):
            return " to ".join(texts)
        return f"({', '.join(texts)})"
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, int):
        return f"{value:,}"
    if value is None:
        return "none"
    return str(value)
