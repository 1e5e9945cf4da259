"""What `mi-splat info` says of a set of photographs: how many have a camera, which way
is up, and where each camera stands around a centre.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from mi_splat.cli.console import UsageError, show
from mi_splat.cli.options import axis_name, up_line
from mi_splat.errors import printable

if TYPE_CHECKING:
    from collections.abc import Sequence

    from mi_splat.cli.info import InfoOptions
    from mi_splat.io.up_axis import UpAxis


@dataclass(frozen=True, slots=True, kw_only=True)
class Placed:
    """Where the camera of an image stands, seen from the centre."""

    name: str  # of the image
    split: str  # train, or test for one that is held out
    azimuth: float  # degrees from +x towards +y, in the world whose up is z
    elevation: float  # degrees above the horizontal plane
    distance: float  # world units


@dataclass(frozen=True, slots=True, kw_only=True)
class SetFacts:
    """What is known of a set without decoding its images."""

    photographs: int  # images that are there, with a camera or without
    missing: int  # images that are listed, and not there
    up: UpAxis
    centre: Sequence[float]  # (3,) world units
    centre_is: str  # what the centre is, in words
    cameras: tuple[Placed, ...]


def facts_of(options: InfoOptions) -> SetFacts:
    """Facts about a set; directions are those of `mi_splat.cameras.directions`."""
    import torch

    from mi_splat.cameras.directions import direction_of
    from mi_splat.cameras.framing import looked_at
    from mi_splat.datasets import load_dataset
    from mi_splat.datasets.folders import unlisted_images
    from mi_splat.io.up_axis import UpAxis

    whole = load_dataset(options.file, split=None)
    held_out = set(load_dataset(options.file, split="test").paths)
    up = whole.up
    if options.up is not None:
        up = UpAxis(options.up, "as --up says")
    if options.splat is not None:
        centre: Sequence[float] = _middle_of_object(options)
        centre_is = "the middle of the object"
    elif options.centre is not None:
        centre = options.centre
        centre_is = "as --centre says"
    else:
        centre = looked_at(whole.cameras).tolist()
        centre_is = "the point that the cameras look at"
    placed = []
    for path, camera in zip(whole.paths, whole.cameras, strict=True):
        direction = direction_of(camera, centre, up.direction)
        offset = camera.position - torch.tensor(centre, dtype=torch.float64)
        placed.append(
            Placed(
                name=path.name,
                split="test" if path in held_out else "train",
                azimuth=direction.azimuth,
                elevation=direction.elevation,
                distance=float(offset.norm()),
            )
        )
    return SetFacts(
        photographs=len(whole) + unlisted_images(whole.listed),
        missing=len(whole.listed) - len(whole),
        up=up,
        centre=centre,
        centre_is=centre_is,
        cameras=tuple(placed),
    )


def _middle_of_object(options: InfoOptions) -> tuple[float, float, float]:
    """The middle of the object of a splat, as orbits and poisons take it."""
    from mi_splat.cameras.framing import bounds
    from mi_splat.io import load_splat
    from mi_splat.selection.select import select

    assert options.splat is not None
    if options.centre is not None:
        raise UsageError.of(
            "--centre", "none with --splat", options.centre, "leave one out"
        )
    if options.selection.click:
        do = "make a mask with `mi-splat select`, and pass --mask"
        raise UsageError.of("--click", "an object without a camera", "a pixel", do)
    scene = load_splat(options.splat)
    rows = select(scene, options.selection)
    middle, _ = bounds(scene.select(rows))
    return middle


def document_of(source: Path, facts: SetFacts) -> dict[str, object]:
    """The facts as JSON can hold them."""
    return {
        "set": str(source),
        "photographs": facts.photographs,
        "missing": facts.missing,
        "placed": len(facts.cameras),
        "held_out": sum(one.split == "test" for one in facts.cameras),
        "up": list(facts.up.direction),
        "up_is": facts.up.reason,
        "centre": list(facts.centre),
        "centre_is": facts.centre_is,
        "cameras": [
            {
                "image": one.name,
                "split": one.split,
                "azimuth": one.azimuth,
                "elevation": one.elevation,
                "distance": one.distance,
            }
            for one in facts.cameras
        ],
    }


def show_facts(source: Path, facts: SetFacts) -> None:
    """The facts for a human, with a line for each camera."""
    placed = facts.cameras
    held_out = sum(one.split == "test" for one in placed)
    middle = ",".join(f"{value:.4g}" for value in facts.centre)
    show(f"set          {printable(str(source))}")
    missing = f"; {facts.missing} more are missing" if facts.missing else ""
    show(f"photographs  {facts.photographs}{missing}")
    show(f"placed       {len(placed)}, of which {held_out} are held out (test)")
    if facts.up.reason == "as --up says":
        show(f"up           {axis_name(facts.up.direction)}")
    else:
        show(f"up           {up_line(facts.up).removeprefix('up is taken as ')}")
    show(f"centre       {middle} ({facts.centre_is})")
    width = max(len(printable(one.name)) for one in placed)
    show(f"\n{'image':{width}}  split  azimuth  elevation  distance")
    for one in placed:
        angles = f"{one.azimuth:7.1f}  {one.elevation:9.1f}"
        name = printable(one.name)
        show(f"{name:{width}}  {one.split:5}  {angles}  {one.distance:8.4g}")
