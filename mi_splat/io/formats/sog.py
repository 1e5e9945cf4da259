"""SOG of PlayCanvas, version 2: lossless WebP images of bytes and codebooks, in a zip
archive.

Source: read-sog.ts and write-sog.ts of github.com/playcanvas/splat-transform, and the
format's page in the PlayCanvas manual. Means are 16 bits over the range of sign(x) ln(1
+ |x|), scales, first SH coefficients and other ones each an index into 256 numbers,
quaternions three bytes and the index of the largest of w, x, y, z. Sizes are read from
the archive's directory and from the images' headers, before anything is decompressed.
"""

import dataclasses
import io
import json
import zipfile
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from mi_splat.io.archives import ZIP_ERRORS, check_directory
from mi_splat.io.errors import SplatFileError
from mi_splat.io.formats.format import Format, Saving
from mi_splat.io.loaded import (
    ROOT_HALF,
    Array,
    Arrays,
    Encoded,
    Loaded,
    Loss,
    Values,
    bytes_of,
    check_count,
    drop_largest,
    read_whole,
    restore_largest,
    validated,
    vanished,
)
from mi_splat.io.parsing import Fields, parse
from mi_splat.io.picture_files import PictureFileError, load_picture, picture_header

_META = "meta.json"
_META_LIMIT = 1 << 20
_COUNTS = (0, 3, 8, 15)
_COLUMNS = 64
_TAG = 252
_STEPS = 65_535
_PICTURE_LIMIT = 1 << 30

Files = Callable[[str, int], bytes]
"""Bytes of the member `name`, which may have at most so many."""

_MOST_MEMBERS = 64
_MOST_PIXELS = 1 << 26
_SPREAD = 1 << 16
_AGAIN = "write or download it again"


_Picture = Callable[..., NDArray[np.uint8]]
"""Reads pixels of an image that a part of meta.json names."""


def read_sog(file: io.FileIO, path: str) -> Loaded:
    """Read a bundled SOG."""
    check_directory(file, path, most=_MOST_MEMBERS)
    data = read_whole(file)
    files = archive_files(data, path)
    size = len(data)
    meta = parse(files(_META, _META_LIMIT), path, limit=_META_LIMIT)
    if meta.values.get("version") != 2:
        do = "convert it with splat-transform"
        raise meta.bad(
            "version", "2", meta.values.get("version", "none, which is an old SOG"), do
        )
    count = meta.whole("count", 0, 1 << 31)
    check_count(count, size, path)

    def picture(
        part: Fields, names: int, number: int, needed: int, width: int | None = None
    ) -> NDArray[np.uint8]:
        """(needed, 4) bytes of the image `number` of `names`, which is `width` wide
        if that is given.
        """
        name = part.texts("files", names)[number]
        data = files(name, min(size, _PICTURE_LIMIT))
        return read_picture(data, f"{path}: {name}", least=needed, width=width)[:needed]

    parts = {name: meta.object(name) for name in ("means", "scales", "quats", "sh0")}
    low, high = (
        np.array(parts["means"].numbers(name, 3, 3)) for name in ("mins", "maxs")
    )
    fine, coarse = (
        picture(parts["means"], 2, number, count)[:, :3] for number in (0, 1)
    )
    quaternions = picture(parts["quats"], 1, 0, count)
    colours = picture(parts["sh0"], 1, 0, count)
    sh = _look_up(parts["sh0"], colours[:, :3])[:, None]
    if "shN" in meta.values:
        sh = np.concatenate([sh, _rest(meta.object("shN"), picture, count)], axis=1)
    logs = low + (high - low) * ((coarse.astype(np.uint32) << 8 | fine) / _STEPS)
    means = np.sign(logs) * np.expm1(np.abs(logs))
    scales = np.exp(
        _look_up(parts["scales"], picture(parts["scales"], 1, 0, count)[:, :3])
    )
    loaded = validated(
        means, scales, _unpack_rotations(quaternions), colours[:, 3] / 255.0, sh
    )
    return dataclasses.replace(
        loaded, is_antialiased=meta.values.get("model") == "antialiased"
    )


def _look_up(part: Fields, indices: NDArray[np.uint8]) -> Array:
    """Values of indices into a codebook; NaN where it is too short."""
    book = np.full(ENTRIES, np.nan)
    numbers = part.numbers("codebook", 1, ENTRIES)
    book[: len(numbers)] = numbers
    values: Array = book[indices]
    return values


def _rest(part: Fields, picture: _Picture, count: int) -> Array:
    """(N, K - 1, 3) SH coefficients after the first, from a palette of rows and an
    index a Gaussian.
    """
    bands = _COUNTS[part.whole("bands", 1, 3)]
    entries = part.whole("count", 1, PALETTE)
    labels = picture(part, 2, 1, count)
    rows = labels[:, 0].astype(np.int64) | labels[:, 1].astype(np.int64) << 8
    used = min(entries, int(rows.max(initial=0)) + 1)
    pixels = picture(
        part, 2, 0, _COLUMNS * bands * -(-used // _COLUMNS), _COLUMNS * bands
    )
    if len(rows) and int(rows.max()) >= entries:
        raise part.bad(
            "count", f"more than {int(rows.max())}, the largest index", entries
        )
    table = _look_up(part, pixels[:, :3]).reshape(-1, bands, 3)
    values: Array = table[rows]
    return values


def write_sog(arrays: Arrays, saving: Saving) -> Encoded:
    """A scene as a bundled SOG, in the scene's order.

    Up to 65,536 Gaussians each have SH of their own. Of more, similar ones share
    theirs: then the SH that changed most are among the losses.
    """
    values = Values.of(arrays)
    logs = np.sign(values.means) * np.log1p(np.abs(values.means))
    low = logs.min(axis=0)
    high = logs.max(axis=0)
    extent = high - low
    steps = np.rint(
        np.divide(logs - low, extent, out=np.zeros_like(logs), where=extent > 0)
        * _STEPS
    ).astype(np.int64)
    scales, scale_indices = codebook(values.log_scales)
    colours, colour_indices = codebook(values.sh[:, 0])
    opacities = bytes_of(values.opacities * 255)
    pictures = {
        "means_l.webp": _opaque(steps & 0xFF),
        "means_u.webp": _opaque(steps >> 8),
        "scales.webp": _opaque(scale_indices),
        "quats.webp": _pack_rotations(values.rotations),
        "sh0.webp": np.concatenate([colour_indices, opacities[:, None]], axis=1),
    }
    meta: dict[str, object] = {
        "version": 2,
        "asset": {"generator": "mi-splat"},
        "count": len(values.means),
        **({"model": "antialiased"} if saving.antialiased else {}),
        "means": {
            "mins": low.tolist(),
            "maxs": high.tolist(),
            "files": ["means_l.webp", "means_u.webp"],
        },
        "scales": {"codebook": scales.tolist(), "files": ["scales.webp"]},
        "quats": {"files": ["quats.webp"]},
        "sh0": {"codebook": colours.tolist(), "files": ["sh0.webp"]},
    }
    members = {name: picture_bytes(_square(rows)) for name, rows in pictures.items()}
    losses = vanished(values.opacities, opacities)
    if values.degree:
        meta["shN"], more, shared = _write_rest(values)
        members |= more
        losses += shared
    return Encoded(
        archive_bytes({**members, _META: json.dumps(meta).encode()}), tuple(losses)
    )


def _write_rest(
    values: Values,
) -> tuple[dict[str, object], dict[str, bytes], list[Loss]]:
    """The entry of meta.json, the images, and the loss of the SH coefficients after
    the first.
    """
    rest = values.sh[:, 1:]
    bands = rest.shape[1]
    rows, labels = palette(rest.reshape(len(rest), -1))
    book, indices = codebook(rows)
    pixels = np.zeros((-(-len(rows) // _COLUMNS) * _COLUMNS, bands, 4), np.uint8)
    pixels[: len(rows), :, :3] = indices.reshape(len(rows), bands, 3)
    pixels[..., 3] = 255
    names = ["shN_centroids.webp", "shN_labels.webp"]
    pictures = {
        names[0]: picture_bytes(pixels.reshape(-1, _COLUMNS * bands, 4)),
        names[1]: picture_bytes(
            _square(_opaque(np.stack([labels & 0xFF, labels >> 8, 0 * labels], axis=1)))
        ),
    }
    entry = {
        "count": len(rows),
        "bands": values.degree,
        "codebook": book.tolist(),
        "files": names,
    }
    off = np.abs(rows[labels] - rest.reshape(len(rest), -1)).max(axis=1)
    lost = int((off > 0).sum())
    if lost:
        shared = [
            Loss(
                "SH shared with similar Gaussians",
                lost,
                float(off.max()),
                "of a coefficient",
            )
        ]
    else:
        shared = []
    return entry, pictures, shared


def _opaque(columns: NDArray[np.integer]) -> NDArray[np.uint8]:
    return np.concatenate(
        [columns.astype(np.uint8), np.full((len(columns), 1), 255, np.uint8)], axis=1
    )


def _square(rows: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """(H, W, 4) image with a row a pixel, nearly square, filled up with zeros."""
    width = 4 * -(-int(np.ceil(len(rows) ** 0.5)) // 4)
    picture = np.zeros((-(-len(rows) // width) * width, 4), np.uint8)
    picture[: len(rows)] = rows
    return picture.reshape(-1, width, 4)


def _pack_rotations(rotations: Array) -> NDArray[np.uint8]:
    largest, others = drop_largest(rotations)
    return np.concatenate(
        [
            bytes_of((others * ROOT_HALF + 0.5) * 255),
            (_TAG + largest[:, None]).astype(np.uint8),
        ],
        axis=1,
    )


def _unpack_rotations(pixels: NDArray[np.uint8]) -> Array:
    """(N, 4) quaternions; not finite where the tag of the largest component is none."""
    tags = pixels[:, 3].astype(np.int64) - _TAG
    quaternions = restore_largest(
        np.maximum(tags, 0), (pixels[:, :3] / 255.0 - 0.5) / ROOT_HALF
    )
    quaternions[tags < 0] = np.nan
    return quaternions


ENTRIES = 256
"""Numbers in a codebook."""

PALETTE = 65_536
"""Rows in a palette of SH."""


def codebook(values: Array) -> tuple[Array, NDArray[np.uint8]]:
    """At most 256 float32 numbers, and for each value the index of the nearest one.

    Up to 256 different values are kept as they are. Of more, half of the numbers are
    evenly spaced over the range, so that no value is off by more than 1/254 of it, and
    half follow the distribution (its quantiles).
    """
    plain = values.astype(np.float32).astype(np.float64)
    book = np.unique(plain)
    if len(book) > ENTRIES:
        half = ENTRIES // 2
        even = np.linspace(book[0], book[-1], half)
        often = np.quantile(plain, (np.arange(half) + 0.5) / half, method="nearest")
        book = np.unique(
            np.concatenate([even, often]).astype(np.float32).astype(np.float64)
        )
    return book, np.searchsorted((book[1:] + book[:-1]) / 2, plain).astype(np.uint8)


def palette(rows: Array) -> tuple[Array, NDArray[np.int64]]:
    """At most 65,536 rows, and for each row of a table (N, C) the index of the one that
    stands for it.

    Up to that many different rows are kept as they are. More are split in two again and
    again, at the mean of the column in which a group spreads most (Heckbert 1982,
    median cut), and each group is replaced by its mean.
    """
    if len(rows) <= PALETTE:
        return rows, np.arange(len(rows))
    different, labels = np.unique(rows, axis=0, return_inverse=True)
    if len(different) <= PALETTE:
        return different, labels.reshape(-1)
    labels = np.zeros(len(rows), np.int64)
    for _ in range(PALETTE.bit_length() - 1):
        groups = int(labels.max()) + 1
        means = _group_means(rows, labels, groups)
        spread = np.empty((groups, rows.shape[1]))
        for column in range(rows.shape[1]):
            away = rows[:, column] - means[labels, column]
            spread[:, column] = np.bincount(labels, away**2, groups)
        widest = spread.argmax(axis=1)[labels]
        value = np.take_along_axis(rows, widest[:, None], 1)[:, 0]
        upper = value > means[labels, widest]
        labels = np.unique(2 * labels + upper, return_inverse=True)[1].reshape(-1)
    return _group_means(rows, labels, int(labels.max()) + 1), labels


def _group_means(rows: Array, labels: NDArray[np.int64], groups: int) -> Array:
    counts = np.bincount(labels, minlength=groups)
    return np.stack(
        [np.bincount(labels, column, groups) / counts for column in rows.T], axis=1
    )


def archive_files(data: bytes, path: str) -> Files:
    """The members of a zip archive."""
    try:
        archive = zipfile.ZipFile(io.BytesIO(data))
    except ZIP_ERRORS as error:
        raise SplatFileError.of(
            path, "a zip archive", str(error)[:100], _AGAIN
        ) from None

    def read(name: str, most: int) -> bytes:
        try:
            member = archive.getinfo(name)
            if member.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
                raise ValueError("packed in a way that cannot be bounded")
            with archive.open(member) as file:
                return _bounded(file.read(most + 1), most, f"{path}: {name}")
        except KeyError:
            got = ", ".join(archive.namelist())[:100] or "an empty archive"
            raise SplatFileError.of(
                path, f"{name} in the archive", got, _AGAIN
            ) from None
        except ZIP_ERRORS as error:
            raise SplatFileError.of(
                f"{path}: {name}", "an intact member", str(error)[:100], _AGAIN
            ) from None

    return read


def _bounded(plain: bytes, most: int, where: str) -> bytes:
    if len(plain) > most:
        raise SplatFileError.of(where, f"at most {most} bytes", "more", _AGAIN)
    return plain


def read_picture(
    data: bytes, where: str, *, least: int, width: int | None = None
) -> NDArray[np.uint8]:
    """(H * W, 4) bytes of the pixels of a lossless WebP image."""
    if data[8:16] != b"WEBPVP8L":
        raise SplatFileError.of(
            where,
            "a lossless WebP image (VP8L)",
            repr(data[:16]),
            "export the SOG again",
        )
    try:
        (columns, rows), _ = picture_header(data, where, formats=("WEBP",))
        pixels = columns * rows
        most = min(4 * least + _SPREAD, _MOST_PIXELS)
        if pixels < least or pixels > most or width not in (None, columns):
            wanted = f"{least} to {most} pixels" + (f", {width} wide" if width else "")
            raise SplatFileError.of(
                where, wanted, f"{columns} x {rows}", "export the SOG again"
            )
        picture = load_picture(data, where, formats=("WEBP",))
    except PictureFileError as error:
        raise SplatFileError(str(error)).hinted(error.hint) from None
    return np.asarray(picture.convert("RGBA")).reshape(-1, 4)


def picture_bytes(values: NDArray[np.uint8]) -> bytes:
    """A lossless WebP of (H, W, 4) bytes; colours under an alpha of zero are kept."""
    buffer = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(values)).save(
        buffer, "WEBP", lossless=True, exact=True, quality=60, method=3
    )
    return buffer.getvalue()


def archive_bytes(members: dict[str, bytes]) -> bytes:
    """A zip archive of members that are compressed already, the same bytes each
    time.
    """
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_STORED) as archive:
        for name, data in members.items():
            archive.writestr(zipfile.ZipInfo(name), data)
    return buffer.getvalue()


SOG = Format(
    name="sog",
    suffixes=(".sog",),
    magic=(b"PK\x03\x04",),
    read=read_sog,
    write=write_sog,
    keeps_antialiasing=True,
    keeps_nothing=False,
    in_archives=True,
)
