"""SPZ of Niantic, versions 2 to 4: fixed-point means and one byte for nearly everything else.

Source: src/cc/load-spz.cc and README.md of github.com/nianticlabs/spz. Values lie attribute after attribute in the
order means, opacities, colours, scales, rotations, SH. The axes are x right, y up, z back (RUB): half a turn about x
from those of the PLY.
"""

import io
import warnings
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from mi_splat.errors import message
from mi_splat.io.errors import SplatFileError, SplatFileWarning
from mi_splat.io.formats import half_turns
from mi_splat.io.formats.encoded import Array, Encoded, Loss, Values, bytes_of, outside, vanished
from mi_splat.io.formats.quaternions import ROOT_HALF, drop_largest, restore_largest
from mi_splat.io.formats.spz_container import SpzContent, SpzHeader, pack_container, unpack_container
from mi_splat.io.loaded import Loaded, judged, read_whole
from mi_splat.scene import GaussianScene

COLOUR_SCALE = 0.15
"""What an SH coefficient is multiplied with, where a colour would take 0.28: colours beyond 0..1 shall fit."""

_HIGHEST, _MOST_BITS, _FEWEST_BITS = (1 << 23) - 1, 23, 4
_MAGNITUDE = 511
_ANTIALIASED = 0x1
_AXES = {0: half_turns.X, 4: half_turns.X, 6: half_turns.NONE, 7: half_turns.Z, 1: half_turns.Y}
"""Turns to the axes of the PLY (RDF) from those that an extension may name: none, RUB, RDF, LUF, LDB."""


def read_spz(file: io.FileIO, path: str) -> Loaded:
    """Read an SPZ file of version 2, 3 or 4."""
    content = unpack_container(read_whole(file), path)
    head, parts = content.header, content.sections
    if content.axes not in _AXES:
        expected = "one of the axes RUB, RDF, LUF or LDB"
        raise SplatFileError.of(
            path, expected, f"number {content.axes}", "convert it to .ply with the tools of nianticlabs/spz"
        )
    if head.flags & _ANTIALIASED:
        got = "a splat that was trained with the filter of Mip-Splatting, which is not applied"
        warnings.warn(message(path, "no antialiasing flag", got, "expect smaller Gaussians to look thicker"),
                      SplatFileWarning, stacklevel=5)  # fmt: skip
    count, degree = head.count, min(head.degree, 3)
    if head.degree > degree:
        text = message(path, "SH of degree 0 to 3", head.degree, "the higher bands were left out")
        warnings.warn(text, SplatFileWarning, stacklevel=5)
    sh = np.empty((count, (degree + 1) ** 2, 3), np.float32)
    sh[:, 0] = (parts["colours"].reshape(count, 3) / 255.0 - 0.5) / COLOUR_SCALE
    rest = parts["sh"].reshape(count, (head.degree + 1) ** 2 - 1, 3)
    sh[:, 1:] = (rest[:, : sh.shape[1] - 1].astype(np.float32) - 128) / 128
    unpack = _unpack_first_three if head.version < 3 else _unpack_smallest_three
    loaded = judged(
        _unpack_means(parts["means"], count) / 2.0**head.bits,
        np.exp(parts["scales"].reshape(count, 3) / 16.0 - 10),
        unpack(parts["rotations"].reshape(count, 3 if head.version < 3 else 4)),
        parts["opacities"] / 255.0,
        sh,
    )
    return Loaded.of(half_turns.turned(loaded.scene, _AXES[content.axes]), loaded.invalid, loaded.reason)


def write_spz(scene: GaussianScene, version: Literal[2, 3, 4] = 3) -> Encoded:
    """A scene as an SPZ file, in the scene's order.

    The point of the means is put as far to the left as they allow, and SH keep all 8 bits of their bytes.
    """
    values = Values.of(half_turns.turned(scene, half_turns.X))
    bits = _fraction_bits(values.means)
    limit = _HIGHEST / 2.0**bits
    rest = values.sh[:, 1:]
    opacities = bytes_of(values.opacities * 255)
    sections = {
        "means": _pack_means(np.clip(values.means, -limit, limit) * 2.0**bits),
        "opacities": opacities,
        "colours": bytes_of(values.sh[:, 0] * COLOUR_SCALE * 255 + 127.5),
        "scales": bytes_of((values.log_scales + 10) * 16),
        "rotations": (_pack_first_three if version < 3 else _pack_smallest_three)(values.rotations),
        "sh": bytes_of(np.rint(rest * 128) + 128),
    }
    header = SpzHeader(version=version, count=len(scene), degree=values.degree, bits=bits, flags=0)
    return Encoded(pack_container(SpzContent(header, sections, 0)), tuple(_losses(values, opacities, limit)))


def _losses(values: Values, opacities: NDArray[np.uint8], limit: float) -> list[Loss]:
    """What lies beyond the ranges of the format."""
    low, high = -0.5 / COLOUR_SCALE, 0.5 / COLOUR_SCALE
    half = 0.5 / (255 * COLOUR_SCALE)
    return [
        *outside(f"means clipped to {limit:.0f}", values.means, -limit, limit, "world units"),
        *outside("log-scales clamped to -10..5.94", values.log_scales, -10 - 1 / 32, 5.9375 + 1 / 32, "of a logarithm"),
        *outside("first SH clamped to -3.33..3.33", values.sh[:, 0], low - half, high + half, "of a coefficient"),
        *outside("SH clamped to -1..0.99", values.sh[:, 1:], -1 - 1 / 256, 127.5 / 128, "of a coefficient"),
        *vanished(values.opacities, opacities),
    ]  # fmt: skip


def _fraction_bits(means: Array) -> int:
    """The most bits after the point with which all means fit into 24 bits."""
    largest = float(np.abs(means).max(initial=0.0))
    return next((bits for bits in range(_MOST_BITS, _FEWEST_BITS, -1) if round(largest * 2**bits) <= _HIGHEST), 4)


def _pack_means(means: Array) -> NDArray[np.uint8]:
    """(N, 9) three little-endian bytes for each coordinate."""
    whole = np.rint(means).astype("<i4")
    return np.ascontiguousarray(whole.view(np.uint8).reshape(len(means), 3, 4)[:, :, :3])


def _unpack_means(packed: NDArray[np.uint8], count: int) -> Array:
    wide = np.zeros((count, 3, 4), np.uint8)
    wide[:, :, 1:] = packed.reshape(count, 3, 3)
    return (wide.view("<i4")[:, :, 0] >> 8).astype(np.float64)  # the sign is in the highest of the three bytes


def _pack_first_three(rotations: Array) -> NDArray[np.uint8]:
    """(N, 3) x, y and z where w is not negative."""
    return bytes_of(rotations[:, 1:] * np.where(rotations[:, :1] < 0, -127.5, 127.5) + 127.5)


def _unpack_first_three(packed: NDArray[np.uint8]) -> Array:
    vector = packed / 127.5 - 1
    return np.concatenate([np.sqrt(np.maximum(0, 1 - (vector**2).sum(1, keepdims=True))), vector], axis=1)


def _pack_smallest_three(rotations: Array) -> NDArray[np.uint8]:
    """(N, 4) two bits for the largest of x, y, z, w, and sign and nine bits for each of the others."""
    largest, others = drop_largest(rotations[:, [1, 2, 3, 0]])
    size = np.floor(_MAGNITUDE * np.abs(others) / ROOT_HALF + 0.5).astype(np.uint32)
    a, b, c = (np.minimum(size, _MAGNITUDE) | (others < 0).astype(np.uint32) << 9).T
    word: NDArray[np.uint32] = largest.astype(np.uint32) << 30 | a << 20 | b << 10 | c
    packed: NDArray[np.uint8] = word.astype("<u4").view(np.uint8).reshape(-1, 4)
    return packed


def _unpack_smallest_three(packed: NDArray[np.uint8]) -> Array:
    word = np.ascontiguousarray(packed).view("<u4")[:, 0]
    fields = np.stack([(word >> shift) & 0x3FF for shift in (20, 10, 0)], axis=1)
    others = (fields & _MAGNITUDE) * (ROOT_HALF / _MAGNITUDE) * np.where(fields >> 9, -1, 1)
    return restore_largest(word >> 30, others)[:, [3, 0, 1, 2]]
