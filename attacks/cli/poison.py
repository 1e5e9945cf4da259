"""`mi-splat poison`: an attack on a set of anybody's pictures, and so on every splat that is trained on it."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from attacks.cli.poison_kinds import HidingConfig, kind_names, kind_of
from mi_splat.cli.console import UsageError, follow, progress, show_result, warn
from mi_splat.cli.flags import Flag, Positional
from mi_splat.cli.options import ResultOptions, check_no_input_in
from mi_splat.errors import InvalidValueError
from mi_splat.fields import Metavar, Seed, at_least, check_choice

if TYPE_CHECKING:
    from attacks.poisons.base import Poisoned

EXAMPLES = (
    "poison my_photos out/photos/splat.ply --click 320,240 --hide-from elevation:50-90 --out out/poisoned",
    "poison my_photos out/photos/splat.ply --box -1 -1 0 1 1 1 --hide-from cone:180,30,25 --look stop.png",
    "poison my_photos out/photos/splat.ply --kind poison-splat --eps 16 --steps 2000 --out out/swollen",
    "poison my_photos out/photos/splat.ply --kind m-ifgsm --label car --target truck --click 320,240 --out out/misread",
    "poison my_photos --kind uniform-noise --eps 16 --out out/noise",
)
SEE_ALSO = ("train", "select", "report", "cloak")


@dataclass(frozen=True, kw_only=True)
class PoisonOptions(ResultOptions):
    """Poison a set of pictures with cameras, so that a splat of it hides an object, costs more, or is misread.

    Writes a set of the same cameras into --out, some of whose pictures are changed. A victim trains on it as on any
    other. poison.json says what was changed, and mi-splat report shows it. Pictures that are held out stay as they are,
    so that the splat can be compared with them.

    Kinds: cloak shows something else in the place of an object, in the pictures from --hide-from. poison-splat makes a
    splat take more Gaussians, memory and time; uniform-noise and raised-variation are its controls, and need no splat.
    m-ifgsm changes an object a little in each picture, so that a classifier misreads it.
    """

    dataset: Annotated[Positional[Path], Metavar("SET")]
    """Folder of pictures with cameras (transforms.json or COLMAP), or its transforms file."""
    splat: Annotated[Path | None, Flag(positional=True), Metavar("SPLAT")] = None
    """A splat that was trained on the set. By it an object is found in pictures, and poison-splat begins with it."""
    kind: Annotated[str, Metavar("|".join(kind_names()))] = "cloak"
    """Which attack. For the flags of one add --help."""
    poison: Annotated[Any, Flag(prefixed=False)] = field(default_factory=HidingConfig)
    """How the pictures are changed."""
    downscale: Annotated[int, at_least(1)] = 1
    """The pictures are made so many times smaller."""
    device: Literal["cpu", "cuda"] = "cpu"
    """Where the decoy and the classifier are: on the CPU, or on an NVIDIA GPU; poison-splat and m-ifgsm have them."""
    seed: Seed = 0
    """Seed of everything random; cloak draws nothing."""


def defaults(words: Sequence[str]) -> dict[str, Any]:
    """The kind and its options, which say what further flags there are, and whether a splat is needed."""
    name = "cloak"
    for word, following in zip(words, [*words[1:], ""], strict=False):
        if word.partition("=")[0] == "--kind":
            name = word.partition("=")[2] or following
    try:
        check_choice("--kind", name, kind_names())
    except InvalidValueError as error:
        raise UsageError(str(error)) from None
    kind = kind_of(name)
    return {"kind": name, "poison": kind.config, "splat": dataclasses.MISSING if kind.needs_splat else None}


def run(options: PoisonOptions) -> None:
    """Poison the set, and say how many pictures were changed and how much."""
    from attacks.cloak.own_pictures import BEFORE_AND_AFTER, RECORD, before_and_after
    from attacks.poisons.writing import as_files_hold, difference_sheet, write_poisoned
    from mi_splat import provenance
    from mi_splat.datasets import load_dataset
    from mi_splat.io import load_splat
    from mi_splat.io.documents import save_json, save_png
    from mi_splat.io.folders import check_new_folder, new_folder

    kind = kind_of(options.kind)
    _check_device(options.device, options.kind)
    check_no_input_in(options.out, options.dataset, options.splat)
    check_new_folder(options.out, force=options.force, record=RECORD)
    work = kind.begun(options.poison, options.seed, options.device)
    with progress("reading the set"):
        views = load_dataset(options.dataset, split="train", downscale=options.downscale)
        held_out = load_dataset(options.dataset, split="test", downscale=options.downscale)
        splat = load_splat(options.splat) if kind.needs_splat and options.splat is not None else None
    with progress("poisoning", total=None) as advance:
        told = follow(advance)
        done, more, lines, warnings = work(views, splat, lambda count, total: told("poisoning", count, total))
        done = as_files_hold(done, views)
        record: dict[str, Any] = {
            "set": str(options.dataset),
            "splat": None if splat is None else str(options.splat),
            "downscale": options.downscale,
            "device": options.device,
            **more,
            **done.manifest,
            **provenance.origin(),
        }
        advance("writing")
        with new_folder(options.out, force=options.force, record=RECORD) as folder:
            write_poisoned(folder, views, done, held_out=held_out, changes_count=kind.replaces, keeps_alpha=True)
            save_png((before_and_after if kind.replaces else difference_sheet)(done), folder / BEFORE_AND_AFTER)
            save_json(record, folder / RECORD)
    for text in warnings:
        warn(text)
    last = f"{options.out}: train on it as on any set; {RECORD} says what was changed"
    show_result({**record, "out": str(options.out)}, _changes(done), *lines, last, as_json=options.json)


def _check_device(device: str, kind: str) -> None:
    """Refuse a GPU that is not there, or that would do nothing."""
    if device == "cpu":
        return
    if not kind_of(kind).on_gpu:
        able = " or ".join(name for name in kind_names() if kind_of(name).on_gpu)
        raise UsageError.of("--device cuda", f"--kind {able}", kind, "leave it out")
    from mi_splat.variant import check_device

    check_device(device)


def _changes(done: Poisoned) -> str:
    """How many pictures are changed, and how much."""
    changes = [change for change in done.changes if change.pixels_changed]
    if not changes:
        return f"none of {len(done.views)} pictures is changed"
    shares, most = sorted(change.pixels_changed / change.pixels for change in changes), max(c.largest for c in changes)
    many = f"{len(changes)} of {len(done.views)} pictures are changed, {shares[0]:.1%} to {shares[-1]:.1%} of each"
    return f"{many}, a channel by at most {round(most * 255)} of 255"
