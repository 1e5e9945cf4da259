"""Splats as 3D Gaussian Splatting writes them: PLY with log-scales, logit opacities and SH channel by channel.

Also read are 2DGS (two scales), the column `filter_3D` of Mip-Splatting and the 8-bit colours of nerfstudio. Comments
of Brush and Postshot say whether a splat was trained with antialiasing.
"""

from __future__ import annotations

import dataclasses
import io
import math
import os
import re
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.lib.recfunctions import structured_to_unstructured
from numpy.typing import NDArray

from mi_splat.io.atomic import atomic_write, write_all
from mi_splat.io.loaded import HIGHER_BANDS, SHOWN, Loaded, judged, unit
from mi_splat.io.ply import Element, Header, Rows, header_bytes, ply_error, read_rows
from mi_splat.sh import colour_to_dc

if TYPE_CHECKING:
    from mi_splat.scene import GaussianScene

_MEANS, _NORMALS, _DC = ["x", "y", "z"], ["nx", "ny", "nz"], ["f_dc_0", "f_dc_1", "f_dc_2"]
_SCALES, _ROTATIONS = ["scale_0", "scale_1", "scale_2"], ["rot_0", "rot_1", "rot_2", "rot_3"]
_RGB, _FILTER = ["red", "green", "blue"], "filter_3D"
REST_COUNTS = (0, 9, 24, 45)
"""Number of f_rest_* properties for SH degree 0 to 3: all of red, then green, then blue."""
_REST_OF_DEGREE_4 = 72
_FLATNESS = 1e-3
"""Third scale of a flat Gaussian, as a share of the smaller of its other two."""
_MODE = re.compile(r"splatrendermode:\s*(\w+)|(?:postshot\.)?(?:antialiased|anti_aliasing)[ =]+(\d)", re.IGNORECASE)


def rest_names(count: int) -> list[str]:
    """Names of the SH properties after the first coefficients."""
    return [f"f_rest_{i}" for i in range(count)]


def is_antialiased(header: Header) -> bool:
    """Whether the comments say that a splat was trained with antialiasing; the last one counts."""
    modes = [match for comment in header.comments if (match := _MODE.fullmatch(comment.strip()))]
    return bool(modes) and ((modes[-1][1] or "").lower() == "mip" or modes[-1][2] == "1")


def read_splat(file: io.FileIO, header: Header, path: str) -> Loaded:
    """Read a splat in any encoding, any kinds of numbers and any order of properties."""
    vertex = header.element("vertex")
    if vertex is None:
        raise ply_error(path, "an element named vertex", ", ".join(e.name for e in header.elements), "pass a splat")
    scale_names, colour_names, rest = _check_properties(vertex, path)
    rows = read_rows(file, header, "vertex", path)
    logits, logs = _columns(rows, ["opacity"])[:, 0], _columns(rows, scale_names)
    if len(scale_names) == 2:
        logs = np.concatenate([logs, logs.min(axis=1, keepdims=True) + math.log(_FLATNESS)], axis=1)
    # As `mi_splat.io.parameters.activate`: in float64, rounded once.
    scales, opacities = np.exp(logs, dtype=np.float64), 1 / (1 + np.exp(-logits.astype(np.float64)))
    opacities[~np.isfinite(logits)] = np.nan
    kinds = vertex.kinds()
    if _FILTER in kinds:  # the 3D smoothing filter, Yu et al. 2024, eq. 9
        wider = np.sqrt(scales**2 + rows[_FILTER].astype(np.float64)[:, None] ** 2)
        opacities, scales = opacities * (scales / wider).prod(axis=1), wider
    colours = _columns(rows, colour_names)
    if colour_names == _RGB:
        colours = colour_to_dc(colours / np.array([_full(kinds[name]) for name in _RGB]))
    kept = min(rest, REST_COUNTS[-1]) // 3
    sh = np.empty((len(rows), 1 + kept, 3), np.float32)
    sh[:, 0] = colours
    used = [name for channel in range(3) for name in rest_names(rest)[channel * rest // 3 :][:kept]]
    sh[:, 1:] = _columns(rows, used).reshape(len(rows), 3, kept).transpose(0, 2, 1)
    loaded = judged(_columns(rows, _MEANS), scales, unit(_columns(rows, _ROTATIONS)), opacities, sh)
    notices = [HIGHER_BANDS] if rest == _REST_OF_DEGREE_4 else []
    if len(scale_names) == 2:
        notices.append(("three scales", "two (a 2DGS splat)", "its flat Gaussians are drawn as very thin ellipsoids"))
    read = {*_MEANS, *_NORMALS, *scale_names, *_ROTATIONS, "opacity", *colour_names, *rest_names(rest), _FILTER}
    unread = [column.name for column in vertex.properties if column.name not in read]
    unread += [f"element {element.name}" for element in header.elements if element is not vertex]
    mode = _FILTER in kinds or is_antialiased(header)
    return dataclasses.replace(loaded, is_antialiased=mode, notices=tuple(notices), unread=tuple(unread))


def _check_properties(vertex: Element, path: str) -> tuple[list[str], list[str], int]:
    """Names of the scales and of the colours, and the number of further SH properties."""
    kinds, rest = vertex.kinds(), sum(column.name.startswith("f_rest_") for column in vertex.properties)
    if rest not in (*REST_COUNTS, _REST_OF_DEGREE_4):
        raise ply_error(path, "0, 9, 24 or 45 properties f_rest_* (SH degree 0 to 3)", rest)
    scales = _SCALES if _SCALES[2] in kinds else _SCALES[:2]
    colours = _RGB if _DC[0] not in kinds and set(_RGB) <= kinds.keys() else _DC
    needed = [*_MEANS, *scales, *_ROTATIONS, "opacity", *colours, *rest_names(rest)]
    missing = [name for name in needed if name not in kinds]
    if missing:
        more = f" and {len(missing) - SHOWN} more" if len(missing) > SHOWN else ""
        do = "pass a splat: this may be a point cloud, or a mesh, of which mi-splat capture takes pictures"
        raise ply_error(path, "the properties of a 3DGS splat", f"no {', '.join(missing[:SHOWN])}{more}", do)
    for name in needed:
        if kinds[name][0] != "f" and name not in _RGB:
            raise ply_error(path, f"{name} as float or double", f"an integer ({kinds[name]})")
    return scales, colours, rest


def _columns(rows: Rows, names: Sequence[str]) -> NDArray[np.floating]:
    """(rows, names) values, without a copy if that can be."""
    if not names or rows.dtype.hasobject:  # plyfile leaves the lists of a row as objects
        return np.stack([rows[name] for name in names], axis=1) if names else np.empty((len(rows), 0), np.float32)
    return np.asarray(structured_to_unstructured(rows[list(names)]))


def _full(kind: str) -> float:
    """The value of a colour channel that is fully lit."""
    return 1.0 if kind[0] == "f" else float(np.iinfo(kind).max)


def write_splat(scene: GaussianScene, path: str | os.PathLike[str], *, antialiased: bool = False) -> None:
    """Save a splat as 3DGS writes it: binary little-endian float32 with zero normals and the scene's SH degree.

    Means and SH of a float32 scene are kept bit for bit; saving what was loaded writes the same bytes again.
    """
    import torch  # reading does without

    from mi_splat.io.parameters import to_raw_parameters

    scene = scene.unchecked(*(value.detach().to("cpu", torch.float32) for value in scene.tensors()))
    values = {name: value.numpy() for name, value in to_raw_parameters(scene).items()}
    rest = values["sh"][:, 1:].transpose(0, 2, 1).reshape(len(scene), 3 * (scene.sh.shape[1] - 1))
    before = values["means"], np.zeros_like(values["means"]), values["sh"][:, 0], rest
    after = values["opacities"][:, None], values["scales"], values["rotations"]
    table = np.concatenate([*before, *after], axis=1, dtype="<f4")
    names = [*_MEANS, *_NORMALS, *_DC, *rest_names(rest.shape[1]), "opacity", *_SCALES, *_ROTATIONS]
    with atomic_write(path) as file:
        write_all(file, memoryview(header_bytes([("vertex", len(scene), "float", names)], antialiased=antialiased)))
        write_all(file, table.reshape(-1).view(np.uint8).data)
