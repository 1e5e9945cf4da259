"""What `mi-splat compare` leaves behind: several renderers on one splat."""

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

from attacks.rate import number
from attacks.report.section import Chart, Figure, Line, Picture, Section, listed, plural, settings
from attacks.tables import Table
from mi_splat.attributes import ATTRIBUTES
from mi_splat.io.documents import file_name

Record = Mapping[str, Any]
_SETTINGS = (
    *("scene", "scene_hash", "gaussians", "background", "near", "gradients", "rounds", "seed", "amplify", "lpips"),
)
MOST_PICTURES = 8
"""Cameras whose pictures a page shows; a sheet has most of a megabyte."""
_KINDS = {"picture": "picture", "picture and gradient": "picture_and_gradient"}
"""What was timed: its name on the page, and its key."""


def read(folder: Path, record: Record) -> Section:
    """The section of a comparison."""
    pairs, cameras = record["pairs"], [camera["name"] for camera in record["cameras"]]
    names, psnr = listed(list(record["methods"])), _psnr(pairs[0])
    beyond = f" Below are the first {MOST_PICTURES} cameras; the folder has the pictures of all."
    return Section(
        kind="renderers compared",
        title=f"{names} on {Path(record['scene']).name}",
        done=(
            f"{names} rendered the {record['gaussians']:,} Gaussians of {record['scene']} from "
            f"{plural(len(cameras), 'camera')}. Pictures were clipped to [0, 1] and compared value by value. "
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
        warnings=(*record["warnings"], *_doubts(record)),
        pictures=tuple(
            Picture(
                path=folder / f"{file_name(camera)}.png",
                caption=f"{camera}: {names}; below, where each two differ, times {record['amplify']:g}. Black is no "
                "difference.",
                wide=True,
            )
            for camera in cameras[:MOST_PICTURES]
        ),
        charts=tuple(_charts(record)),
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


def _charts(record: Record) -> Iterator[Chart]:
    timed = {name: method for name, method in record["methods"].items() if method["picture"] is not None}
    yield Chart.bars(
        "Do the gradients point the same way?",
        ("attribute", "cosine"),
        ATTRIBUTES,
        *(
            Line.of(_named(pair), "other", [pair["gradients"][name]["cosine"] for name in ATTRIBUTES])
            for pair in _with_gradients(record)
        ),
        caption="1 is the same direction, 0 says that one knows nothing of the other.",
        fractions=False,
    )
    yield Chart.bars(
        f"Time of a picture, {next(iter(timed), '')} = 1",
        ("method", "times the first"),
        timed,
        *(
            Line.of(words, "other", [method[kind] and method[kind]["ratio"] for method in timed.values()])
            for words, kind in _KINDS.items()
        ),
        caption="Medians of the ratios within a round; compiling is not in it.",
        fractions=False,
    )


def _with_gradients(record: Record) -> list[Record]:
    return [pair for pair in record["pairs"] if pair["gradients"] is not None]


def _tables(record: Record) -> Iterator[Table]:
    pairs = record["pairs"]
    yield Table.of(
        "Pictures, over all cameras; LPIPS: less is nearer",
        {
            "pair": _named,
            "PSNR": _psnr,
            "SSIM": lambda pair: _measured(pair["ssim"]),
            "LPIPS": lambda pair: _measured(pair["lpips"]),
            "bits": "bits",
        },
        pairs,
    )
    by_camera = [
        {"camera": camera["name"], **{_named(pair): _psnr(pair["by_camera"][camera["name"]]) for pair in pairs}}
        for camera in record["cameras"]
    ]
    yield Table.of("PSNR by camera", {title: title for title in by_camera[0]}, by_camera)
    gradients = {_named(pair): pair["gradients"] for pair in _with_gradients(record)}
    yield Table.of(
        "Gradients: cosine, its median over Gaussians, length of the difference over that of the first",
        {"attribute": str, **{title: _agreement(figures) for title, figures in gradients.items()}},
        ATTRIBUTES if gradients else (),
    )
    yield Table.of(
        "Cost of a picture: median time, ratio to the first, growth of memory; the first call may compile",
        {
            "method": "name",
            "first call": lambda method: number(method["first_seconds"], ".3f", "s"),
            **{
                f"{words}: {title}": _cost(kind, key, form, unit)
                for words, kind in _KINDS.items()
                for title, key, form, unit in (
                    ("time", "seconds", ".3f", "s"),
                    ("ratio", "ratio", ".2f", ""),
                    ("memory", "memory_mib", ".0f", "MiB"),
                )
            },
        },
        [{"name": name, **method} for name, method in record["methods"].items()],
    )


def _measured(value: float | None) -> str:
    return "not measured" if value is None else number(value, ".4f")


def _agreement(gradients: Record) -> Callable[[str], str]:
    def words(attribute: str) -> str:
        figures = gradients[attribute]
        if figures["cosine"] is None:
            return "no gradient, or not finite"
        return ", ".join(number(figures[key], ".3f") for key in ("cosine", "median_cosine", "relative_error"))

    return words


def _cost(kind: str, key: str, form: str, unit: str) -> Callable[[Record], str]:
    return lambda method: number(method[kind] and method[kind][key], form, unit)
