"""What `mi-splat compare` leaves behind: several renderers on one splat."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from attacks.report.section import Chart, Figure, Line, Picture, Point, Section
from attacks.report.wording import listed, number, plural, settings
from attacks.tables import Table
from mi_splat.attributes import ATTRIBUTES
from mi_splat.io.documents import file_name

KIND = "renderers compared"
_SETTINGS = (
    "scene",
    "scene_hash",
    "gaussians",
    "background",
    "near",
    "gradients",
    "rounds",
    "seed",
    "amplify",
    "lpips",
)
MOST_PICTURES = 8
"""Cameras whose pictures a page shows; a sheet has most of a megabyte."""
_ALONE, _BOTH = "picture", "picture_and_gradient"
_BIASED = "volprim"
_BIASED_ATTRIBUTES = "means, scales and rotations"


def read(folder: Path, found: Mapping[str, Any], *, files: Path | None = None) -> Section:
    """The section of a comparison.

    Args:
        folder: Where it lies.
        found: Its result.json.
        files: Where its pictures lie now, if they are on the way to the folder.
    """
    methods, pairs, cameras = found["methods"], found["pairs"], [one["name"] for one in found["cameras"]]
    first, *others = pairs
    return Section(
        kind=KIND,
        title=f"{listed(list(methods))} on {Path(found['scene']).name}",
        done=(
            f"{listed(list(methods))} rendered the {found['gaussians']:,} Gaussians of {found['scene']} from "
            f"{plural(len(cameras), 'camera')}. Pictures were clipped to [0, 1] and compared value by value. "
            "A gradient is that of the sum of a picture's values, each times a fixed random number."
            f"{_left_out(cameras)}"
        ),
        conclusion=(
            f"{_named(first)}: {_psnr(first, long=True)}{_worst(first)}. This says how much the choice of the renderer "
            "matters for this splat from these cameras, not which picture is right."
        ),
        headline=_figure(first),
        attacked=False,
        figures=tuple(_figure(pair) for pair in others),
        warnings=(*found["warnings"], *_doubts(found)),
        pictures=tuple(_picture(files or folder, name, found) for name in cameras[:MOST_PICTURES]),
        charts=tuple(_charts(found)),
        tables=tuple(_tables(found)),
        configuration=settings(
            {**{key: found[key] for key in _SETTINGS}, "methods": list(found["given"]), "cameras": cameras}
        ),
    )


def _left_out(cameras: Sequence[str]) -> str:
    """What to say where there are more cameras than the page shows."""
    if len(cameras) <= MOST_PICTURES:
        return ""
    return f" Below are the first {MOST_PICTURES} cameras; the folder has the pictures of all."


def _named(pair: Mapping[str, Any]) -> str:
    one, other = pair["methods"]
    return f"{one} and {other}"


def _psnr(figures: Mapping[str, Any], *, long: bool = False) -> str:
    if figures["psnr"] is None:
        return "the same pictures" if long else "equal"
    return number(figures["psnr"], unit="dB") + (" apart" if long else "")


def _worst(pair: Mapping[str, Any]) -> str:
    """The camera whose pictures are farthest apart, where there are several."""
    known = {name: one["psnr"] for name, one in pair["by_camera"].items() if one["psnr"] is not None}
    if len(pair["by_camera"]) < 2 or not known:
        return ""
    name = min(known, key=lambda one: float(known[one]))
    return f" over all cameras, {number(known[name], unit='dB')} from {name}"


def _figure(pair: Mapping[str, Any]) -> Figure:
    return Figure(label=f"PSNR between {_named(pair)}", words=_psnr(pair), note=_worst(pair).strip())


def _doubts(found: Mapping[str, Any]) -> list[str]:
    """What a reader has to know before the figures are believed."""
    doubts = []
    eight = [name for name, one in found["methods"].items() if one["bits"] == 8]
    if eight:
        doubts.append(f"Pictures of {listed(eight)} come from files with 8 bits a channel; both sides are rounded so")
    if _BIASED in found["methods"] and found["gradients"]:
        doubts.append(f"Gradients of volprim are wrong in {_BIASED_ATTRIBUTES} where Gaussians overlap")
    if len(found["cameras"]) == 1:
        doubts.append("There is one camera; others may give other figures")
    return doubts


def _picture(folder: Path, camera: str, found: Mapping[str, Any]) -> Picture:
    names = listed(list(found["methods"]))
    return Picture(
        path=folder / f"{file_name(camera)}.png",
        caption=f"{camera}: {names}; below, where each two differ, times {found['amplify']:g}. Black is no difference.",
        alt=f"Pictures of {names} from the camera {camera}, and maps of their differences",
        wide=True,
    )


def _charts(found: Mapping[str, Any]) -> list[Chart]:
    charts = []
    compared = [pair for pair in found["pairs"] if pair["gradients"] is not None]
    if compared:
        charts.append(
            Chart(
                title="Do the gradients point the same way?",
                caption="1 is the same direction, 0 says that one knows nothing of the other.",
                x_label="attribute",
                y_label="cosine",
                lines=tuple(
                    Line(name=_named(pair), role="other", points=_points([_cosine(pair, one) for one in ATTRIBUTES]))
                    for pair in compared
                ),
                ticks=ATTRIBUTES,
                fractions=False,
                connected=False,
            )
        )
    timed = {name: one for name, one in found["methods"].items() if one[_ALONE] is not None}
    if timed:
        kinds = {"picture": _ALONE, "picture and gradient": _BOTH}
        charts.append(
            Chart(
                title=f"Time of a picture, {next(iter(timed))} = 1",
                caption="Medians of the ratios within a round; compiling is not in it.",
                x_label="method",
                y_label="times the first",
                lines=tuple(
                    Line(
                        name=words,
                        role="other",
                        points=_points([one[kind] and one[kind]["ratio"] for one in timed.values()]),
                    )
                    for words, kind in kinds.items()
                ),
                ticks=tuple(timed),
                fractions=False,
                connected=False,
            )
        )
    return [chart for chart in charts if any(line.points for line in chart.lines)]


def _points(values: Sequence[float | None]) -> tuple[Point, ...]:
    return tuple(Point(place, value) for place, value in enumerate(values) if value is not None)


def _cosine(pair: Mapping[str, Any], attribute: str) -> float | None:
    found: float | None = pair["gradients"][attribute]["cosine"]
    return found


def _tables(found: Mapping[str, Any]) -> list[Table]:
    pairs = found["pairs"]
    unmeasured = "not measured"
    tables = [
        Table(
            caption="Pictures, over all cameras; LPIPS: less is nearer",
            head=("pair", "PSNR", "SSIM", "LPIPS", "bits"),
            rows=tuple(
                (
                    _named(pair),
                    _psnr(pair),
                    number(pair["ssim"], ".4f") if pair["ssim"] is not None else unmeasured,
                    number(pair["lpips"], ".4f") if pair["lpips"] is not None else unmeasured,
                    str(pair["bits"]),
                )
                for pair in pairs
            ),
        ),
        Table(
            caption="PSNR by camera",
            head=("camera", *map(_named, pairs)),
            rows=tuple(
                (one["name"], *(_psnr(pair["by_camera"][one["name"]]) for pair in pairs)) for one in found["cameras"]
            ),
        ),
    ]
    compared = [pair for pair in pairs if pair["gradients"] is not None]
    if compared:
        tables.append(
            Table(
                caption="Gradients: cosine, its median over Gaussians, length of the difference over that of the first",
                head=("attribute", *map(_named, compared)),
                rows=tuple((name, *(_agreement(pair["gradients"][name]) for pair in compared)) for name in ATTRIBUTES),
            )
        )
    head = ("method", "first call", "picture", "ratio", "memory", "with gradient", "ratio", "memory")
    rows = tuple(
        (name, number(one["first_seconds"], ".3f", "s"), *_cost(one)) for name, one in found["methods"].items()
    )
    caption = "Cost of a picture: median time, ratio to the first, growth of memory; the first call may compile"
    return [*tables, Table(caption=caption, head=head, rows=rows)]


def _agreement(one: Mapping[str, Any]) -> str:
    if one["cosine"] is None:
        return "no gradient, or not finite"
    return ", ".join(number(one[key], ".3f") for key in ("cosine", "median_cosine", "relative_error"))


def _cost(method: Mapping[str, Any]) -> list[str]:
    cells: list[str] = []
    for kind in (_ALONE, _BOTH):
        one = method[kind]
        memory = one and one["memory_mib"]
        cells += (
            ["-", "-", "-"]
            if one is None
            else [
                number(one["seconds"], ".3f", "s"),
                number(one["ratio"], ".2f"),
                number(memory, ".0f", "MiB"),
            ]
        )
    return cells
