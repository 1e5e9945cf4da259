"""From a `Selection` to the mask of its Gaussians, and what is doubtful about it."""

import io
import math
import os
import tokenize
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch
from numpy.lib import format as npy
from numpy.typing import NDArray
from torch import Tensor

from mi_splat.cameras.camera import Camera, RenderFn
from mi_splat.errors import InvalidValueError
from mi_splat.io.documents import save_bytes
from mi_splat.io.errors import SplatFileError, from_os_error
from mi_splat.io.loaded import open_regular, read_whole
from mi_splat.io.points import load_points
from mi_splat.scene import GaussianScene
from mi_splat.selection.clusters import clusters
from mi_splat.selection.config import Selection
from mi_splat.selection.visibility import pixel_weights

_NPY_HEADER = 10_000
"""Bytes that a header may have; NumPy's own limit."""
_READERS = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}
# What NumPy raises for headers that are broken in one way or another: it reads them as
# Python.
_BROKEN = (
    *(
        ValueError,
        EOFError,
        TypeError,
        SyntaxError,
        LookupError,
        AttributeError,
        ArithmeticError,
        RecursionError,
    ),
    *(MemoryError, tokenize.TokenError),
)


def box_mask(
    scene: GaussianScene, box: tuple[float, float, float, float, float, float]
) -> Tensor:
    """(N,) bool, which Gaussians have their means in a box; those on its faces
    count.
    """
    low, high = torch.tensor([box[:3], box[3:]], dtype=torch.float64)
    local = scene.means.detach().cpu().double() - (low + high) / 2
    inside: Tensor = (local.abs() <= (high - low) / 2).all(1)
    return inside


def load_mask(path: Path, scene: GaussianScene) -> Tensor:
    """(N,) bool, which Gaussians of a scene a file names."""
    if path.suffix.lower() == ".npy":
        return _from_array(load_array(path), len(scene), str(path))
    if path.suffix.lower() == ".ply":
        return _at_positions(load_points(path).points, scene, path)
    do = "save a mask with numpy.save, or a part of the splat as PLY"
    raise InvalidValueError.of(
        str(path), "a file that ends in .npy or .ply", path.suffix or "no ending", do
    )


def save_mask(mask: Tensor, path: Path) -> None:
    """Save a (N,) bool mask as .npy; the file appears whole or not at all."""
    buffer = io.BytesIO()
    np.save(buffer, mask.detach().cpu().numpy().astype(bool))
    save_bytes(buffer.getvalue(), path)


def _from_array(values: NDArray[np.generic], count: int, what: str) -> Tensor:
    """A mask from bools, from zeros and ones, or from row numbers."""
    if values.ndim != 1 or values.dtype.kind not in "biu":
        got = f"{values.dtype} of shape {values.shape}"
        do = "pass a one-dimensional array"
        raise InvalidValueError.of(what, f"({count},) bools, or row numbers", got, do)
    binary = values.dtype.kind == "b" or (
        len(values) == count and bool(((values == 0) | (values == 1)).all())
    )
    if binary:
        if len(values) != count:
            raise InvalidValueError.of(
                what,
                f"{count} bools, one a Gaussian",
                len(values),
                "make it from this scene",
            )
        return torch.from_numpy(values.astype(bool))
    rows = torch.from_numpy(values.astype(np.int64))
    if len(rows) and not bool(((rows >= 0) & (rows < count)).all()):
        got = f"{int(rows.min())} to {int(rows.max())}"
        raise InvalidValueError.of(
            what, f"row numbers in 0..{count - 1}", got, "make them from this scene"
        )
    mask = torch.zeros(count, dtype=torch.bool)
    mask[rows] = True
    return mask


def _at_positions(points: Tensor, scene: GaussianScene, path: Path) -> Tensor:
    """Which Gaussians lie exactly at one of the points."""
    wanted, ours = (_keys(values) for values in (points, scene.means.detach().cpu()))
    strange = int((~np.isin(wanted, ours)).sum())
    if strange:
        got = f"{strange:,} of {len(wanted):,} that are not"
        do = (
            "pass a part of this very splat, not one that was moved, resized or"
            " trained on"
        )
        raise InvalidValueError.of(
            str(path), "positions that are those of Gaussians of the scene", got, do
        )
    return torch.from_numpy(np.isin(ours, wanted))


def _keys(points: Tensor) -> NDArray[np.void]:
    """Each (N, 3) position as one value that is equal where all three numbers are."""
    # of -0 and 0, 0
    values = np.ascontiguousarray(points.numpy().astype(np.float32) + np.float32(0))
    keys: NDArray[np.void] = values.view(np.dtype((np.void, 12)))[:, 0]
    return keys


def load_array(path: Path) -> NDArray[np.generic]:
    """The array in a .npy file, never of objects; what its header says is held against
    the bytes that are there.
    """
    expected = "an array of NumPy (.npy)"
    do = "save it with numpy.save"
    try:
        with open_regular(str(path)) as file:
            head = io.BytesIO(os.pread(file.fileno(), _NPY_HEADER, 0))
            size = os.fstat(file.fileno()).st_size
            version = npy.read_magic(head)
            if version not in _READERS:
                raise ValueError(f"version {version[0]}.{version[1]} of the format")
            shape, column_first, kind = _READERS[version](head)
            if kind.hasobject:
                raise ValueError("pickled objects, which may run code")
            needed = head.tell() + math.prod(shape) * kind.itemsize
            if needed != size or min(shape, default=0) < 0:
                raise ValueError(f"{size} bytes where the header asks for {needed}")
            data = memoryview(read_whole(file))[head.tell() :]
        return np.ndarray(shape, kind, data, order="F" if column_first else "C")
    except OSError as error:
        raise from_os_error(str(path), expected, error) from error
    except _BROKEN as error:
        got = " ".join(str(error).split())[:160] or type(error).__name__
        raise SplatFileError.of(str(path), expected, got, do) from error


FEWEST = 10
"""A selection of fewer Gaussians is doubted."""
MOST = 0.95
"""A selection of a larger share of the scene is doubted."""
SEEN = 0.5
"""A pixel shows the object where this share of it is the object's."""
_AROUND = 1.5
"""How far around a click is looked, in halves of the image's diagonal at its
depth.
"""
_CLICKED = 0.05
"""Share of a clicked pixel that what the images select makes up at least."""
_NAMED = 4
"""Cameras that are named at most."""


def select(
    scene: GaussianScene,
    selection: Selection,
    *,
    objects: Mapping[str, slice] | None = None,
    camera: Camera | None = None,
    render: RenderFn | None = None,
    found: Tensor | None = None,
) -> Tensor:
    """The Gaussians of one object.

    Args:
        scene: The scene.
        selection: Which; of several selectors together, what all of them select.
        objects: Rows of the parts of a scene file, for `Selection.object`.
        camera: Whose image is clicked on, for `Selection.click`.
        render: Makes that image, for `Selection.click`.
        found: (N,) bool, what images say (`mi_splat.selection.regions.vote`), for
            `Selection.detect`, `boxes` and `masks`. A click then chooses among these
            Gaussians, so that what it is connected to is not the floor.

    Returns:
        (N,) bool, at least one of them true.

    Raises:
        InvalidValueError: Nothing is selected, the selection does not fit the scene, or
            something that it needs is not given.
        SplatFileError: A mask file cannot be read.
    """
    if selection.is_empty:
        do = _HOW + (f"; parts: {', '.join(objects)}" if objects else "")
        raise InvalidValueError.of(
            "selection", "which Gaussians are meant", "nothing", do
        ).hinted(_FLAGS)
    mask = torch.ones(len(scene), dtype=torch.bool)
    if selection.object is not None:
        if selection.object not in (objects or {}):
            if objects:
                expected = f"one of {', '.join(objects)}"
            else:
                expected = "no name, since the scene has no parts"
            raise InvalidValueError.of(
                "object", expected, selection.object, _HOW
            ).hinted(_FLAGS)
        part = torch.zeros_like(mask)
        part[(objects or {})[selection.object]] = True
        mask &= part
    if selection.box is not None:
        mask &= box_mask(scene, selection.box)
    if selection.mask is not None:
        mask &= load_mask(selection.mask, scene)
    if selection.needs_images:
        if found is None:
            raise InvalidValueError.of(
                "selection",
                "what the images say (found)",
                "None",
                "pass the votes of mi_splat.selection.regions.vote",
            )
        mask &= found
    if selection.cluster is not None:
        labels = _clusters(scene, selection)
        if selection.cluster > (count := len(labels.bincount())):
            raise InvalidValueError.of(
                "cluster", f"1 to {count:,}", selection.cluster, "1 is the largest"
            )
        mask &= labels == selection.cluster - 1
    if selection.click:
        mask &= _clicked(scene, selection, camera, render, among=found)
    if not bool(mask.any()):
        do = f"look at where it is in an image of the scene; {_HOW}"
        raise InvalidValueError.of(
            "selection", "at least one Gaussian", f"none of {len(scene):,}", do
        ).hinted(_FLAGS)
    return mask


_HOW = "name a part (object), or say a box, a click, a cluster or a mask"
_FLAGS = "--object, --box, --click, --cluster, --mask, --detect, --boxes or --masks"


def doubts(mask: Tensor, weights: Mapping[str, Tensor]) -> list[str]:
    """Reasons to look twice at a selection, in words."""
    count = int(mask.sum())
    total = len(mask)
    texts = []
    if count < FEWEST:
        texts.append(
            f"the selection has {count} of {total:,} Gaussians, which is hardly an"
            " object"
        )
    if count > MOST * total:
        texts.append(
            f"the selection has {count:,} of {total:,} Gaussians: nearly the whole"
            " scene, surroundings, too"
        )
    hidden = _hidden(weights)
    if hidden:
        texts.append(
            f"the selection does not show {hidden}; something hides it, or it is"
            " outside the image"
        )
    return texts


def require_visible(weights: Mapping[str, Tensor]) -> None:
    """Raise unless an object shows from every camera."""
    hidden = _hidden(weights)
    if hidden:
        do = "leave these cameras out, or choose others"
        raise InvalidValueError.of(
            "cameras", "views that show the selection", f"none {hidden}", do
        )


def _hidden(weights: Mapping[str, Tensor]) -> str:
    """From where an object does not show, in words; empty if it shows from
    everywhere.
    """
    hidden = {
        name: float(weight.max())
        for name, weight in weights.items()
        if not bool((weight >= SEEN).any())
    }
    if not hidden:
        return ""
    names = ", ".join(list(hidden)[:_NAMED]) + (", ..." if len(hidden) > _NAMED else "")
    counts = f"{len(hidden)} of {len(weights)} cameras"
    return (
        f"from {names} ({counts}; at most {max(hidden.values()):.0%} of any pixel is"
        " its)"
    )


def _clusters(scene: GaussianScene, selection: Selection) -> Tensor:
    return clusters(
        scene,
        link_distance=selection.link_distance,
        link_colour=selection.link_colour,
        planes=selection.planes,
    )


def _clicked(
    scene: GaussianScene,
    selection: Selection,
    camera: Camera | None,
    render: RenderFn | None,
    *,
    among: Tensor | None,
) -> Tensor:
    """The components that make up most of the pixels that were clicked on, of all
    Gaussians or among some.
    """
    if camera is None or render is None:
        raise InvalidValueError.of(
            "click", "a camera and a renderer", "none", "say in whose image"
        )
    mask = torch.zeros(len(scene), dtype=torch.bool)
    means = scene.means.detach().cpu().double()
    for pixel in selection.pixels:
        weights = pixel_weights(scene, camera, pixel, render).cpu().double()
        if among is not None:
            weights = torch.where(among, weights, 0)
            _require_found(weights, pixel)
        point = means[int(weights.argmax())]
        # half a diagonal at depth 1
        shown = math.hypot(camera.width / camera.fx, camera.height / camera.fy) / 2
        depth = float((point - camera.position).norm())
        # So the largest plane is the one that the object stands on, and not a floor or
        # a wall far away.
        is_near = (means - point).norm(dim=1) <= _AROUND * shown * depth
        near = (is_near if among is None else is_near & among).nonzero()[:, 0]
        labels = _clusters(scene.select(near), selection)
        label = int(torch.bincount(labels, weights[near]).argmax())
        mask[near[labels == label]] = True
    return mask


def _require_found(weights: Tensor, pixel: tuple[int, int]) -> None:
    """Raise where a click is on none of the Gaussians that the images select."""
    x, y = pixel
    if float(weights.sum()) < _CLICKED:
        got = f"one of which it makes up {float(weights.sum()):.1%}"
        do = "click on the object, or leave the click out"
        raise InvalidValueError.of(
            f"click {x},{y}", "a pixel of what the images select", got, do
        )
