"""What `mi-splat compare` leaves behind: several renderers on one splat."""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from attacks.rate import number
from attacks.report.section import Figure, Picture, Section, listed, settings
from attacks.tables import Column, Table
from mi_splat.attributes import ATTRIBUTES
from mi_splat.errors import counted
from mi_splat.io.documents import file_name

Record = Mapping[str, Any]


_SETTINGS = (*("scene", "scene_hash", "gaussians", "background", "near", "gradients", "rounds", "seed", "amplify"),)
MOST_PICTURES = 8
"""Cameras whose pictures a page shows; a sheet has most of a megabyte."""
_TIMED = {"picture": "picture", "picture and gradient": "picture_and_gradient"}
"""What was timed: its name on the page, and its key."""
_COSTS = {"time": ("seconds", ".3f", "s"), "ratio": ("ratio", ".2f", "")}
"""What was measured of it: key, format and unit."""


def read_comparison(folder: Path, record: Record) -> Section:
    """The section of a comparison."""
    pairs, cameras = record["pairs"], [camera["name"] for camera in record["cameras"]]
    names, psnr = listed(list(record["methods"])), _psnr(pairs[0])
    beyond = f" Below are the first {MOST_PICTURES} cameras; the folder has the pictures of all."
    shown = f"{names}; below, where each two differ, times {record['amplify']:g}. Black is no difference."
    return Section(
        kind="renderers compared",
        title=f"{names} on {Path(record['scene']).name}",
        done=(
            f"{names} rendered the {record['gaussians']:,} Gaussians of {record['scene']} from "
            f"{counted(len(cameras), 'camera')}. Pictures were clipped to [0, 1] and compared value by value. "
            "A gradient is that of the sum of a picture's values, each times a fixed random number."
            f"{beyond if len(cameras) > MOST_PICTURES else ''}"
        ),
        conclusion=(
            f"{_named(pairs[0])}: {'the same pictures' if psnr == 'equal' else f'{psnr} apart'}{_worst(pairs[0])}. "
            "This says how much the choice of the renderer matters for this splat from these cameras, not which "
            "picture is right."
        ),
        headline=_figure(pairs[0]),
        attacked=False,
        figures=tuple(map(_figure, pairs[1:])),
        warnings=tuple(_doubts(record)),
        pictures=tuple(
            Picture(path=folder / f"{file_name(camera)}.png", caption=f"{camera}: {shown}", wide=True)
            for camera in cameras[:MOST_PICTURES]
        ),
        tables=tuple(_tables(record)),
        configuration=settings(
            {**{key: record[key] for key in _SETTINGS}, "methods": list(record["given"]), "cameras": cameras}
        ),
    )


def _named(pair: Record) -> str:
    return " and ".join(pair["methods"])


def _psnr(figures: Record) -> str:
    return "equal" if figures["psnr"] is None else number(figures["psnr"], unit="dB")


def _worst(pair: Record) -> str:
    """The camera whose pictures are farthest apart, where there are several."""
    known = {name: figures["psnr"] for name, figures in pair["by_camera"].items() if figures["psnr"] is not None}
    if len(pair["by_camera"]) < 2 or not known:
        return ""
    name = min(known, key=lambda camera: float(known[camera]))
    return f" over all cameras, {number(known[name], unit='dB')} from {name}"


def _figure(pair: Record) -> Figure:
    return Figure(label=f"PSNR between {_named(pair)}", words=_psnr(pair), note=_worst(pair).strip())


def _doubts(record: Record) -> Iterator[str]:
    """What a reader has to know before the figures are believed."""
    eight = [name for name, method in record["methods"].items() if method["bits"] == 8]
    if eight:
        yield f"Pictures of {listed(eight)} come from files with 8 bits a channel; both sides are rounded so"
    if "volprim" in record["methods"] and record["gradients"]:
        yield "Gradients of volprim are wrong in means, scales and rotations where Gaussians overlap"
    if len(record["cameras"]) == 1:
        yield "There is one camera; others may give other figures"


def _tables(record: Record) -> Iterator[Table]:
    pairs, cameras = record["pairs"], [camera["name"] for camera in record["cameras"]]
    measured: dict[str, Column[Record]] = {
        "pair": _named,
        "PSNR": _psnr,
        "SSIM": lambda pair: number(pair["ssim"], ".4f"),
        "bits": "bits",
    }
    yield Table.of("Pictures, over all cameras", measured, pairs)
    by_camera: dict[str, Column[str]] = {"camera": str}
    by_camera |= {_named(pair): lambda camera, pair=pair: _psnr(pair["by_camera"][camera]) for pair in pairs}  # type: ignore[misc]
    yield Table.of("PSNR by camera", by_camera, cameras)
    agreements: dict[str, Column[str]] = {"attribute": str}
    agreements |= {
        _named(pair): lambda attribute, pair=pair: _agreement(pair["gradients"][attribute])  # type: ignore[misc]
        for pair in pairs
        if pair["gradients"] is not None
    }
    yield Table.of(
        "Gradients: cosine, its median over Gaussians, length of the difference over that of the first",
        agreements,
        ATTRIBUTES if len(agreements) > 1 else (),
    )
    costs: dict[str, Column[Record]] = {
        "method": "name",
        "first call": lambda method: number(method["first_seconds"], ".3f", "s"),
    }
    costs |= {
        f"{words}: {title}": lambda method, kind=kind, title=title: _cost(method[kind], title)  # type: ignore[misc]
        for words, kind in _TIMED.items()
        for title in _COSTS
    }
    yield Table.of(
        "Cost of a picture: median time, ratio to the first; the first call may compile",
        costs,
        [{"name": name, **method} for name, method in record["methods"].items()],
    )


def _agreement(gradients: Record) -> str:
    if gradients["cosine"] is None:
        return "no gradient, or not finite"
    return ", ".join(number(gradients[key], ".3f") for key in ("cosine", "median_cosine", "relative_error"))


def _cost(cost: Record | None, title: str) -> str:
    key, form, unit = _COSTS[title]
    return number(None if cost is None else cost[key], form, unit)
