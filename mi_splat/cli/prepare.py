"""`mi-splat prepare`: a set of images with cameras from photographs or a video."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from mi_splat.cli.console import follow, progress, show_result, warn
from mi_splat.cli.flags import Positional
from mi_splat.cli.options import JsonOptions, check_no_input_in
from mi_splat.errors import listed
from mi_splat.fields import OutFolder
from mi_splat.preparation.config import PreparationError, PrepareConfig

EXAMPLES = (
    "prepare YOUR_PHOTOS --out out/desk",
    "prepare walk.mp4 --out out/walk --interval 0.5",
)
FEW_POINTS = 100
"""Of the model: an image that shows fewer may be in a wrong place."""
MASKS = "masks"
"""Folder beside the photographs that is taken for their masks."""


@dataclass(frozen=True, kw_only=True)
class PrepareOptions(JsonOptions):
    """Find the cameras of photographs or of a video with COLMAP, and write a set to
    train on.

    The set contains the registered images, turned upright, a COLMAP model whose z is
    up, and prepare.json, which lists the images that could not be registered. If COLMAP
    finds several models, the largest is kept. Images of one size and focal length share
    a camera. COLMAP is in the extra photos.
    """

    source: Positional[Path]
    """A folder of photographs (JPEG, PNG, WebP, BMP, TIFF), or a video (MP4, MOV, MKV,
    WebM, AVI).
    """
    out: OutFolder
    """Folder for the set: a new one, written whole at the end."""
    masks: Path | None = None
    """Folder of masks, named as the photographs; black pixels are ignored. Default: the
    folder masks beside the photographs, if it exists.
    """
    force: bool = False
    """Replace an older set in --out."""
    config: PrepareConfig = field(default_factory=PrepareConfig)
    """How large the images are, and how many."""


def check_inputs(options: PrepareOptions) -> None:
    """Raise unless the source exists."""
    if not options.source.exists():
        expected = "a folder of photographs, or a video"
        do = "check the path"
        raise PreparationError.of(str(options.source), expected, "no such file", do)


def run(options: PrepareOptions) -> None:
    """Prepare the set, and say what was placed and what was not."""
    from mi_splat.preparation.prepare import RECORD, prepare

    masks = options.masks
    if masks is None and (options.source / MASKS).is_dir():
        masks = options.source / MASKS
    check_no_input_in(options.out, options.source, masks)
    with progress("preparing") as advance:
        record = prepare(
            options.source,
            options.out,
            options.config,
            masks=masks,
            force=options.force,
            on_progress=follow(advance),
        )
    _warn(record)
    images = record["images"]
    counts = {
        part: sum(row["part"] == part for row in images) for part in ("train", "test")
    }
    placed = sum(counts.values())
    count = len(images) + len(record["broken"])
    lines = (
        (
            f"{placed} of {count} images placed: {counts['train']} for training,"
            f" {counts['test']} held out"
        ),
        (
            f"{record['points']:,} points, {record['reprojection_error']:.2f} pixels"
            " off on average; z is up"
        ),
        f"{options.out}: a set for `mi-splat train`; {RECORD} lists what was placed",
    )
    show_result({**record, "out": str(options.out)}, *lines, as_json=options.json)


def _warn(record: Mapping[str, Any]) -> None:
    """Name what was not placed, or not well."""
    from mi_splat.preparation.prepare import not_placed

    missing = not_placed(record)
    if missing:
        warn(f"not placed: {listed(missing, width=120)}")
    placed = [row for row in record["images"] if row["part"] != "none"]
    weak = [row["source"] for row in placed if row["points"] < FEW_POINTS]
    if weak:
        warn(
            f"perhaps in a wrong place, since they show fewer than {FEW_POINTS} points:"
            f" {listed(weak)}"
        )
    if len(record["models"]) > 1:
        sizes = ", ".join(map(str, record["models"]))
        warn(
            f"the images fall into {len(record['models'])} models, of {sizes} images:"
            " the largest is taken"
        )
