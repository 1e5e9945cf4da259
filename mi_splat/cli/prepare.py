"""`mi-splat prepare`: a set of pictures with cameras from photographs or a video."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from mi_splat.cli.console import follow, progress, show_result, warn
from mi_splat.cli.flags import Positional
from mi_splat.cli.options import JsonOptions, check_no_input_in
from mi_splat.fields import OutFolder
from mi_splat.preparation.config import PreparationError, PrepareConfig

EXAMPLES = (
    "prepare YOUR_PHOTOS --out out/desk",
    "prepare walk.mp4 --out out/walk --interval 0.5",
)
LISTED = 6
"""Pictures that are named which could not be placed, or not well."""
FEW_POINTS = 100
"""Of the model: a picture that shows fewer may be in a wrong place."""


@dataclass(frozen=True, kw_only=True)
class PrepareOptions(JsonOptions):
    """Find out where pictures were taken from, and write them with their cameras as a set to train on.

    The set has the pictures that could be placed, a COLMAP model whose z is up, contact_sheet.png with all pictures,
    and prepare.json, which lists what could not be placed. Every eighth picture is held out. Cameras are found by
    COLMAP: pip install -e '.[colmap]', and for a video -e '.[colmap,video]'.
    """

    source: Positional[Path]
    """A folder of pictures (JPEG, PNG, WebP, BMP, TIFF), or a video (MP4, MOV, MKV, WebM, AVI)."""
    out: OutFolder
    """Folder for the set: a new one, written whole at the end."""
    force: bool = False
    """Replace an older set in --out."""
    config: PrepareConfig = field(default_factory=PrepareConfig)
    """How large the pictures are, and how many."""


def check_inputs(options: PrepareOptions) -> None:
    """Raise unless the source exists."""
    if not options.source.exists():
        expected, do = "a folder of images, or a video", "check the path"
        raise PreparationError.of(str(options.source), expected, "no such file", do)


def run(options: PrepareOptions) -> None:
    """Prepare the set, and say what was placed and what was not."""
    from mi_splat.preparation.prepare import RECORD, SHEET, not_placed, prepare

    check_no_input_in(options.out, options.source)
    with progress("preparing") as advance:
        record = prepare(options.source, options.out, options.config, force=options.force, on_progress=follow(advance))
    pictures, missing = record["pictures"], not_placed(record)
    counts = {part: sum(row["part"] == part for row in pictures) for part in ("train", "test")}
    if missing:
        warn(f"not placed: {_named(missing)}")
    if weak := [row["source"] for row in pictures if row["part"] != "none" and row["points"] < FEW_POINTS]:
        warn(f"perhaps in a wrong place, since they show fewer than {FEW_POINTS} points: {_named(weak)}")
    if len(record["models"]) > 1:
        sizes = ", ".join(map(str, record["models"]))
        warn(f"the pictures fall into {len(record['models'])} models, of {sizes} pictures: the largest is taken")
    placed, count = sum(counts.values()), len(pictures) + len(record["broken"])
    lines = (
        f"{placed} of {count} pictures are placed: {counts['train']} for training, {counts['test']} held out",
        f"{record['points']:,} points, {record['reprojection_error']:.2f} pixels off on average; z is up",
        f"{options.out}: train on it as on any set; {SHEET} shows the pictures, {RECORD} lists them",
    )
    show_result({**record, "out": str(options.out)}, *lines, as_json=options.json)


def _named(pictures: Sequence[str]) -> str:
    more = f", and {len(pictures) - LISTED} more" if len(pictures) > LISTED else ""
    return f"{', '.join(pictures[:LISTED])}{more}"
