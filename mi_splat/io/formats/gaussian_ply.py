"""Splats in PLY files as 3D Gaussian Splatting writes them.

Also 2DGS (two scales), the column `filter_3D` of Mip-Splatting and the 8-bit colours of
nerfstudio are read.
"""

from __future__ import annotations

import dataclasses
import io
import math
import re
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.lib.recfunctions import structured_to_unstructured
from numpy.typing import NDArray

from mi_splat.io.errors import SplatFileError
from mi_splat.io.formats.compressed_ply import read_compressed_ply, write_compressed_ply
from mi_splat.io.formats.format import Format, Saving
from mi_splat.io.loaded import (
    HIGHER_BANDS,
    SHOWN,
    Arrays,
    Encoded,
    Loaded,
    Notice,
    arrays_of,
    as_scene,
    ranges,
    unit,
    validated,
)
from mi_splat.io.ply import (
    REST_COUNTS,
    Element,
    Header,
    Rows,
    header_bytes,
    ply_error,
    read_header,
    read_rows,
    rest_names,
)
from mi_splat.io.up_axis import commented_up
from mi_splat.maths.sh import colour_to_dc

if TYPE_CHECKING:
    from mi_splat.scene import GaussianScene

_MEANS = ["x", "y", "z"]
_NORMALS = ["nx", "ny", "nz"]
_DC = ["f_dc_0", "f_dc_1", "f_dc_2"]
_SCALES = ["scale_0", "scale_1", "scale_2"]
_ROTATIONS = ["rot_0", "rot_1", "rot_2", "rot_3"]
_RGB = ["red", "green", "blue"]
_FILTER = "filter_3D"
_REST_OF_DEGREE_4 = 72
_FLATNESS = 1e-3
"""Third scale of a flat Gaussian, as a share of the smaller of its other two."""
_POINT = 1e-9
"""Scale of a Gaussian that has none at all, world units: what is seen of it is the
rasteriser's low-pass filter.
"""
_OF_SPLATS = ("f_dc_", "f_rest_", "scale_", "rot_", "opacity")
_PREFIX = re.compile(
    r"^scal(ar)?_(?=n[xyz]$|f_dc_|f_rest_|scale_|rot_|opacity$|filter_3D$)"
)
_TIME = re.compile(r"t|scale_t|rot_r_\d|trbf_\w+|motion_\d+|omega_\d+|velocity_\d+")
"""Columns of splats that move: 4D Gaussian Splatting (Yang et al. 2024), Spacetime
Gaussians (Li et al. 2024).
"""


def read_ply(file: io.FileIO, path: str) -> Loaded:
    """Read a splat in any encoding, any kinds of numbers and any order of
    properties.
    """
    header = read_header(file, path)
    if header.is_compressed:
        return read_compressed_ply(file, path)
    stored = header.elements.get("vertex")
    if stored is None:
        raise ply_error(
            path, "an element named vertex", ", ".join(header.elements), "pass a splat"
        )
    vertex = _usual_names(stored)
    scale_names, colour_names, rest = _check_properties(vertex, header, path)
    rows = read_rows(file, header, "vertex", path)
    kinds = vertex.kinds
    rows.dtype.names = tuple(kinds)
    logits = _columns(rows, ["opacity"])[:, 0]
    logs = _columns(rows, scale_names)
    if len(scale_names) == 2:
        logs = np.concatenate(
            [logs, logs.min(axis=1, keepdims=True) + math.log(_FLATNESS)], axis=1
        )
    infinite = np.isinf(logits) | np.isneginf(logs).any(axis=1)
    logs = _without_minus_infinity(logs)
    scales, opacities = _activated(logs, logits)
    if _FILTER in kinds:  # the 3D smoothing filter, Yu et al. 2024, eq. 9
        wider = np.sqrt(scales**2 + rows[_FILTER].astype(np.float64)[:, None] ** 2)
        opacities = opacities * (scales / wider).prod(axis=1)
        scales = wider
    colours = _columns(rows, colour_names)
    if colour_names == _RGB:
        full = [
            1.0 if kinds[name][0] == "f" else np.iinfo(kinds[name]).max for name in _RGB
        ]
        colours = colour_to_dc(colours / np.array(full, np.float64))
    kept = min(rest, REST_COUNTS[-1]) // 3
    sh = np.empty((len(rows), 1 + kept, 3), np.float32)
    sh[:, 0] = colours
    used = [
        name
        for channel in range(3)
        for name in rest_names(rest)[channel * rest // 3 :][:kept]
    ]
    sh[:, 1:] = _columns(rows, used).reshape(len(rows), 3, kept).transpose(0, 2, 1)
    loaded = validated(
        _columns(rows, _MEANS), scales, unit(_columns(rows, _ROTATIONS)), opacities, sh
    )
    notices = [HIGHER_BANDS] if rest == _REST_OF_DEGREE_4 else []
    notices += _moving(vertex)
    if len(scale_names) == 2:
        notices.append(
            (
                "three scales",
                "two (a 2DGS splat)",
                "its flat Gaussians are drawn as very thin ellipsoids",
            )
        )
    read = {
        *_MEANS,
        *_NORMALS,
        *scale_names,
        *_ROTATIONS,
        "opacity",
        *colour_names,
        *rest_names(rest),
        _FILTER,
    }
    unread = [name for name in vertex.columns if name not in read]
    unread += [f"element {name}" for name in header.elements if name != "vertex"]
    mode = _FILTER in kinds or header.is_antialiased
    return dataclasses.replace(
        loaded,
        is_antialiased=mode,
        infinite=tuple(np.setdiff1d(np.flatnonzero(infinite), loaded.invalid).tolist()),
        notices=tuple(notices),
        unread=tuple(unread),
        stated_up=commented_up(header.comments),
    )


def _usual_names(vertex: Element) -> Element:
    """The columns by the names of 3DGS, where CloudCompare and 3dgsconverter put
    `scalar_` and `scal_` before them.
    """
    usual = {name: _PREFIX.sub("", name) for name in vertex.columns}
    if len(set(usual.values())) < len(usual):  # the file has both names
        return vertex
    return Element(
        vertex.count, {usual[name]: kinds for name, kinds in vertex.columns.items()}
    )


def _moving(vertex: Element) -> list[Notice]:
    """A notice where the columns are those of a splat that moves."""
    times = [name for name in vertex.columns if _TIME.fullmatch(name)]
    if not times or times == ["t"]:  # which may be anything
        return []
    got = f"one that moves (4D: {', '.join(ranges(times))})"
    return [
        ("a splat of one moment", got, "the Gaussians of all times are drawn at once")
    ]


def _activated(
    logs: NDArray[np.floating], logits: NDArray[np.floating]
) -> list[NDArray[np.floating]]:
    """Scales and opacities as `mi_splat.io.parameters.activate` computes them: in
    float64, rounded once.

    An infinite logit is an opacity of 0 or 1, as SuperSplat and splat-transform read
    it.
    """
    opacities = 1 / (1 + np.exp(-logits.astype(np.float64)))
    return [np.exp(logs, dtype=np.float64), opacities]


def _without_minus_infinity(logs: NDArray[np.floating]) -> NDArray[np.floating]:
    """Logarithms of scales in which a scale of 0 is that of a flat Gaussian, or of a
    point.
    """
    empty = np.isneginf(logs)
    if not empty.any():
        return logs
    smallest = np.where(empty, np.inf, logs).min(axis=1, keepdims=True)
    flat = np.where(
        np.isposinf(smallest), math.log(_POINT), smallest + math.log(_FLATNESS)
    )
    return np.asarray(np.where(empty, flat, logs).astype(logs.dtype))


def _check_properties(
    vertex: Element, header: Header, path: str
) -> tuple[list[str], list[str], int]:
    """Names of the scales and of the colours, and the number of further SH
    properties.
    """
    kinds = vertex.kinds
    rest = sum(name.startswith("f_rest_") for name in vertex.columns)
    if any(name.startswith("f_anchor_feat") for name in vertex.columns):
        got = (
            "the anchors of a Scaffold-GS, of which a network makes Gaussians for each"
            " view"
        )
        raise ply_error(
            path,
            "the properties of a 3DGS splat",
            got,
            "train a plain 3DGS on the same images",
        )
    if rest not in (*REST_COUNTS, _REST_OF_DEGREE_4):
        raise ply_error(
            path, "0, 9, 24 or 45 properties f_rest_* (SH degree 0 to 3)", rest
        )
    scales = _SCALES if _SCALES[2] in kinds else _SCALES[:2]
    colours = _RGB if _DC[0] not in kinds and set(_RGB) <= kinds.keys() else _DC
    needed = [*_MEANS, *scales, *_ROTATIONS, "opacity", *colours, *rest_names(rest)]
    missing = [name for name in needed if name not in kinds]
    if missing:
        raise _no_splat(vertex, header, missing, path)
    for name in needed:
        if kinds[name][0] != "f" and name not in _RGB:
            raise ply_error(
                path, f"{name} as float or double", f"an integer ({kinds[name]})"
            )
    return scales, colours, rest


def _no_splat(
    vertex: Element, header: Header, missing: Sequence[str], path: str
) -> SplatFileError:
    """The error of a PLY without properties of a splat: it says what the file is, as
    far as its header tells.
    """
    more = f" and {len(missing) - SHOWN} more" if len(missing) > SHOWN else ""
    lacks = f"no {', '.join(missing[:SHOWN])}{more}"
    has_some = any(name.startswith(_OF_SPLATS) for name in vertex.columns)
    faces = header.elements.get("face")
    got = lacks
    do = "export the splat again"
    if faces is not None and faces.count and not has_some:
        got = f"a mesh of {faces.count:,} faces"
        do = (
            "save it as .glb, then `mi-splat capture MESH.glb` renders images to train"
            " a splat on"
        )
    elif not has_some:
        got = f"a point cloud ({lacks})"
        do = (
            "pass a splat; one is trained on images and their cameras with `mi-splat"
            " train SET`"
        )
    return ply_error(path, "the properties of a 3DGS splat", got, do)


def _columns(rows: Rows, names: Sequence[str]) -> NDArray[np.floating]:
    """(rows, names) values, without a copy if that can be."""
    if names:
        return np.asarray(structured_to_unstructured(rows[list(names)]))
    return np.empty((len(rows), 0), np.float32)


def write_ply(arrays: Arrays, saving: Saving) -> Encoded:
    """A splat as 3DGS writes it: binary little-endian float32 with zero normals and the
    scene's SH degree.
    """
    values = _raw(arrays)
    means = values["means"]
    sh = values["sh"]
    # all of red, then green, then blue
    rest = sh[:, 1:].transpose(0, 2, 1).reshape(len(sh), 3 * (sh.shape[1] - 1))
    columns = (
        (_MEANS, means),
        (_NORMALS, np.zeros_like(means)),
        (_DC, sh[:, 0]),
        (rest_names(rest.shape[1]), rest),
        (["opacity"], values["opacities"][:, None]),
        (_SCALES, values["scales"]),
        (_ROTATIONS, values["rotations"]),
    )
    names = [name for some, _ in columns for name in some]
    table = np.concatenate([value for _, value in columns], axis=1, dtype="<f4")
    vertex = Element(len(means), dict.fromkeys(names, ("f4",)))
    head = header_bytes({"vertex": vertex}, antialiased=saving.antialiased)
    return Encoded(table.reshape(-1).view(np.uint8).data, (), head=head)


def through_ply(scene: GaussianScene) -> GaussianScene:
    """What `load_splat` reads from the PLY that `save_splat` writes of a scene: to the
    bit, without the file.
    """
    values = _raw(arrays_of(scene))
    physical = _activated(values["scales"], values["opacities"])
    loaded = validated(
        values["means"], physical[0], values["rotations"], physical[1], values["sh"]
    )
    return loaded.settle("a saved scene", "raise", stacklevel=2).scene


def _raw(arrays: Arrays) -> dict[str, NDArray[np.float32]]:
    """The arrays of a scene as the file holds them."""
    # imports torch, which reading does without
    from mi_splat.io.parameters import to_raw_parameters

    raw = to_raw_parameters(as_scene(arrays))
    return {name: value.numpy() for name, value in raw.items()}


PLY = Format(
    name="ply",
    suffixes=(".ply",),
    magic=(b"ply",),
    read=read_ply,
    write=write_ply,
    keeps_antialiasing=True,
    in_archives=True,
)
COMPRESSED_PLY = Format(
    name="compressed-ply",
    suffixes=(".compressed.ply",),
    magic=(b"ply",),
    read=read_ply,
    write=write_compressed_ply,
    keeps_antialiasing=True,
)
