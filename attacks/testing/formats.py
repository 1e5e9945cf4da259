"""The contract of a file format of splats: what `mi_splat.io` promises of each
ending.
"""

from __future__ import annotations

import tempfile
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import torch
from scipy.spatial import cKDTree

from attacks.testing.promises import Contract, cloud, expect
from mi_splat.errors import MiSplatError
from mi_splat.io import SplatLossWarning, load_splat, save_splat
from mi_splat.io.formats.format import FORMATS, Format
from mi_splat.scene import GaussianScene

_COUNT = 50
_PLACES = 0.01
_SIZES = 0.15
_OPACITIES = 0.02
_COLOURS = 0.05
"""How far a lossy format may move means (world units), scales (a part of them),
opacities and colours of degree 0.
"""
_CUTS = (0, 1, 3, 40)
"""Shares of a file that is cut off, in per cent; one byte less, since some formats are
rows without a header.
"""


def check_format(format: Format | str) -> None:
    """Raise unless a format of splats keeps its contract.

    A small splat is written and read again: the same Gaussians come back, twice the
    same bytes are written, a file of what was read does not drift, and a file that was
    cut off is refused in words.

    Args:
        format: The format, which need not be registered, or the ending of its files,
            for instance ".spz".

    Raises:
        ContractError: It does not; the message lists all that is wrong.
    """
    if isinstance(format, str):
        _check_suffix(format)
        return
    with _registered(format):
        for suffix in format.suffixes:
            _check_suffix(suffix)


@contextmanager
def _registered(format: Format) -> Iterator[None]:
    """Let the commands know a format for a while."""
    is_new = format.name not in FORMATS
    if is_new:
        FORMATS.add(format.name, format)
    try:
        yield
    finally:
        if is_new:
            del FORMATS.own[format.name]


def _check_suffix(suffix: str) -> None:
    contract = Contract(f"format {suffix}")
    scene = cloud(_COUNT, degree=1, size=0.5)
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore", SplatLossWarning)
        first, second = (
            Path(folder) / f"{name}{suffix}" for name in ("first", "second")
        )
        with contract.promise("writing"):
            save_splat(scene, first)
            save_splat(scene, second)
            same = first.read_bytes() == second.read_bytes()
            expect(
                same,
                "the same bytes for the same splat",
                "others",
                "write no times and no random names",
            )
        contract.settle()
        with contract.promise("reading"):
            _same_gaussians(load_splat(first), scene)
        with contract.promise("drift"):
            once = load_splat(first)
            save_splat(once, second)
            _same_gaussians(load_splat(second), once)
        data = first.read_bytes()
        for share in _CUTS:
            with contract.promise(f"a file of which {share} % is there"):
                first.write_bytes(data[: max(len(data) * share // 100 - 1, 0)])
                _is_refused(first)
    contract.settle()


def _same_gaussians(read: GaussianScene, written: GaussianScene) -> None:
    """Some formats sort Gaussians, so that each has the nearest one as its partner."""
    expect(
        len(read) == len(written), f"{len(written)} Gaussians", len(read), "keep all"
    )
    distances, partners = cKDTree(read.means.numpy()).query(written.means.numpy())
    expect(
        distances.max() <= _PLACES,
        f"means within {_PLACES}",
        f"{distances.max():.3g} away",
        "keep their places",
    )
    one_each = len(np.unique(partners)) == len(written)
    expect(one_each, "a partner for each Gaussian", "some with none", "keep all")
    read = read.select(torch.from_numpy(partners))
    ratio = float(
        (read.scales.sort().values / written.scales.sort().values - 1).abs().max()
    )
    expect(
        ratio <= _SIZES,
        f"scales within {_SIZES:.0%}",
        f"{ratio:.0%}",
        "keep their sizes",
    )
    opacity = float((read.opacities - written.opacities).abs().max())
    expect(
        opacity <= _OPACITIES,
        f"opacities within {_OPACITIES}",
        f"{opacity:.3g}",
        "keep them",
    )
    colour = float((read.sh[:, 0] - written.sh[:, 0]).abs().max())
    expect(
        colour <= _COLOURS, f"colours within {_COLOURS}", f"{colour:.3g}", "keep them"
    )


def _is_refused(path: Path) -> None:
    try:
        load_splat(path)
    except MiSplatError:
        return
    expect(
        False,
        "SplatFileError for a part of a file",
        "an answer",
        "hold its sizes against the bytes that are there",
    )
