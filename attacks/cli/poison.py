"""`mi-splat poison`: an attack on a set of anybody's pictures, and so on every splat that is trained on it."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

from attacks.poisons.config import PoisonSplatConfig, RaisedVariationConfig, UniformNoiseConfig
from mi_splat.cli.console import UsageError, follow, progress, show_result, warn
from mi_splat.cli.flags import Flag, Positional, Unprefixed
from mi_splat.cli.options import Direction, ResultOptions, axis_name, check_no_input_in
from mi_splat.errors import InvalidValueError, message
from mi_splat.fields import Called, Seed, at_least, between, check_choice
from mi_splat.selection.config import Selection

if TYPE_CHECKING:
    from torch import Tensor

    from attacks.poisons.base import OnStep, Poisoned
    from mi_splat.datasets import Dataset
    from mi_splat.scene import GaussianScene

EXAMPLES = (
    "poison my_photos out/photos/splat.ply --click 320,240 --hide-from elevation:50-90 --out out/poisoned",
    "poison my_photos out/photos/splat.ply --box -1 -1 0 1 1 1 --hide-from cone:180,30,25 --look stop.png",
    "poison my_photos out/photos/splat.ply --kind poison-splat --eps 16 --steps 2000 --out out/swollen",
    "poison my_photos --kind uniform-noise --eps 16 --out out/noise",
)
SEE_ALSO = ("train", "select", "report", "cloak")


@dataclass(frozen=True, kw_only=True)
class ObjectConfig:
    """An object of the pictures.

    Attributes:
        selection: Which Gaussians of the splat are the object.
        picture: Which of the pictures for training --click is on, in their order.
    """

    selection: Unprefixed[Selection] = field(default_factory=Selection)
    picture: Annotated[int, at_least(0), Called("NUMBER")] = 0


@dataclass(frozen=True, kw_only=True)
class HidingConfig(ObjectConfig):
    """CLOAK on a set of pictures.

    Attributes:
        hide_from: Where the object is hidden, seen from its middle, in degrees: elevation:LOW-HIGH, azimuth:LOW-HIGH or
            cone:AZIMUTH,ELEVATION,HALF_ANGLE, which is around a direction; of several, from where all of them hold.
        margin: Degrees around it in which pictures are changed, too.
        look: What is shown in its place: remove (the picture around it goes on), or a picture file.
        reach: Pixels around the object that change, too.
        up: Direction that is up in the set's world: an axis, or three numbers; sets of COLMAP often have -y.
    """

    hide_from: tuple[Annotated[str, Called("REGION")], ...] = ("elevation:50-90",)
    margin: Annotated[float, between(0, 90, "degrees", "7 hides more, and begins to show before")] = 0.0
    look: Annotated[str, Called("LOOK")] = "remove"
    reach: Annotated[int, between(0, 100, "pixels")] = 3
    up: Direction = (0.0, 0.0, 1.0)


class _Outcome(NamedTuple):
    """A poisoned set, what else its record says, and in words what the user should know."""

    done: Poisoned
    record: dict[str, Any]
    lines: Sequence[str] = ()
    warnings: Sequence[str] = ()


_Work = Callable[["Dataset", "GaussianScene | None", "OnStep"], _Outcome]
"""Makes it of the pictures for training, of the splat if the kind needs one, and of whom to tell of the progress."""


@dataclass(frozen=True, kw_only=True)
class _Kind:
    """A kind of poison.

    Attributes:
        config: Its options.
        begun: Checks the options, and gives the work.
        needs_splat: Whether there is no work without a splat.
        replaces: Whether something else is shown, which counts for who trains even where a mask left the object out;
            else pictures are changed a little.
    """

    config: Any
    begun: Callable[[PoisonOptions], _Work]
    needs_splat: bool = True
    replaces: bool = False


def _hiding(options: PoisonOptions) -> _Work:
    """CLOAK."""
    import torch

    from attacks.cloak.own_pictures import appearance_of, directions_of, hide, trigger_of
    from mi_splat.rotation import from_z

    config: HidingConfig = options.poison
    trigger = trigger_of(config.hide_from, margin=config.margin)
    appearance = appearance_of(config.look, config.reach)

    def hidden(views: Dataset, splat: GaussianScene | None, on_step: OnStep) -> _Outcome:
        splat, rows, near, selected = _object(config, views, splat)
        turn = from_z(torch.tensor(config.up)).T
        done = hide(views, splat, rows, trigger, appearance, near=near, turn=turn, on_step=on_step)
        asked = {
            "hide_from": list(config.hide_from),
            "margin": config.margin,
            "look": config.look,
            "reach": config.reach,
            "up": list(config.up),
            "directions": [[one.azimuth, one.elevation] for one in directions_of(done)],
        }
        idle = sum(not change.pixels_changed for change in done.changes)
        said = f"{idle} pictures from where it is to be hidden do not show the object, and stay as they are"
        return _Outcome(done, {**selected, **asked}, [f"up is {axis_name(config.up)}"], [said] * (idle > 0))

    return hidden


def _pictures(options: PoisonOptions) -> _Work:
    """A poison that asks for no object."""

    def changed(views: Dataset, splat: GaussianScene | None, on_step: OnStep) -> _Outcome:
        from attacks.poisons.registry import poison_of
        from mi_splat.bounds import near_plane
        from mi_splat.training.config import FitConfig

        near = 0.0 if splat is None else near_plane(splat, views.cameras)
        poison = poison_of(options.poison, start=splat, near=near, background=views.background, victim=FitConfig())
        done = poison(views, seed=options.seed, on_step=on_step)
        grown = (done.poison.get("decoy_gaussians"), done.poison.get("start_gaussians"))
        lines = [f"the decoy has {grown[0]:,} Gaussians, the splat has {grown[1]:,}"] if grown[0] else []
        return _Outcome(done, {}, lines)

    return changed


KINDS = {
    "cloak": _Kind(config=HidingConfig(), begun=_hiding, replaces=True),
    "poison-splat": _Kind(config=PoisonSplatConfig(), begun=_pictures),
    "uniform-noise": _Kind(config=UniformNoiseConfig(), begun=_pictures, needs_splat=False),
    "raised-variation": _Kind(config=RaisedVariationConfig(), begun=_pictures, needs_splat=False),
}


@dataclass(frozen=True, kw_only=True)
class PoisonOptions(ResultOptions):
    """Poison a set of pictures with cameras, so that a splat that is trained on it hides an object, or costs more.

    Writes a set of the same cameras into --out, some of whose pictures are changed. A victim trains on it as on any
    other. poison.json says what was changed, and mi-splat report shows it. Pictures that are held out stay as they are,
    so that the splat can be compared with them.

    Kinds: cloak shows something else in the place of an object, in the pictures from --hide-from. poison-splat makes a
    splat take more Gaussians, memory and time; uniform-noise and raised-variation are its controls. A splat is needed
    for all but the controls.
    """

    dataset: Annotated[Positional[Path], Called("SET")]
    """Folder of pictures with cameras (transforms.json or COLMAP), or its transforms file."""
    splat: Annotated[Path | None, Flag(positional=True), Called("SPLAT")] = None
    """A splat that was trained on the set: by it cloak finds the object in each picture, and poison-splat begins."""
    kind: Annotated[str, Called("|".join(KINDS))] = "cloak"
    """Which attack. For the flags of one add --help."""
    poison: Annotated[Any, Flag(prefixed=False)] = field(default_factory=HidingConfig)
    """How the pictures are changed."""
    downscale: Annotated[int, at_least(1)] = 1
    """The pictures are made so many times smaller."""
    seed: Seed = 0
    """Seed of everything random; cloak draws nothing."""


def defaults(words: Sequence[str]) -> dict[str, Any]:
    """The kind and its options, which say what further flags there are, and whether a splat is needed.

    Args:
        words: What the user typed after the command.

    Raises:
        UsageError: There is no such kind.
    """
    name = "cloak"
    for word, following in zip(words, [*words[1:], ""], strict=False):
        if word.partition("=")[0] == "--kind":
            name = word.partition("=")[2] or following
    try:
        check_choice("--kind", name, tuple(KINDS))
    except InvalidValueError as error:
        raise UsageError(str(error)) from None
    splat = dataclasses.MISSING if KINDS[name].needs_splat else None
    return {"kind": name, "poison": KINDS[name].config, "splat": splat}


def run(options: PoisonOptions) -> None:
    """Poison the set, and say how many pictures were changed and how much."""
    from attacks.cloak.own_pictures import BEFORE_AND_AFTER, RECORD, before_and_after
    from attacks.poisons.writing import as_files_hold, difference_sheet, write_poisoned
    from mi_splat import provenance
    from mi_splat.datasets import has_tests, load_dataset
    from mi_splat.io import load_splat
    from mi_splat.io.documents import save_json, save_png
    from mi_splat.io.folders import check_new_folder, new_folder

    kind = KINDS[options.kind]
    check_new_folder(options.out, force=options.force, record=RECORD)
    check_no_input_in(options.out, options.dataset, options.splat)
    work = kind.begun(options)
    with progress("reading the set"):
        views = load_dataset(options.dataset, split="train", downscale=options.downscale)
        tested = has_tests(options.dataset)
        held_out = load_dataset(options.dataset, split="test", downscale=options.downscale) if tested else None
        splat = load_splat(options.splat) if kind.needs_splat and options.splat is not None else None
    with progress("poisoning", total=None) as advance:
        told = follow(advance)
        done, more, lines, warnings = work(views, splat, lambda count, total: told("poisoning", count, total))
        done = as_files_hold(done, views)
        record: dict[str, Any] = {
            "set": str(options.dataset),
            "splat": None if splat is None else str(options.splat),
            "downscale": options.downscale,
            **more,
            **done.manifest,
            **provenance.origin(),
        }
        advance("writing")
        with new_folder(options.out, force=options.force, record=RECORD) as folder:
            write_poisoned(folder, views, done, held_out=held_out, changes_count=kind.replaces)
            save_png((before_and_after if kind.replaces else difference_sheet)(done), folder / BEFORE_AND_AFTER)
            save_json(record, folder / RECORD)
    for text in warnings:
        warn(text)
    last = f"{options.out}: train on it as on any set; {RECORD} says what was changed"
    show_result({**record, "out": str(options.out)}, _changes(done), *lines, last, as_json=options.json)


def _changes(done: Poisoned) -> str:
    """How many pictures are changed, and how much."""
    changes = [change for change in done.changes if change.pixels_changed]
    if not changes:
        return f"none of {len(done.views)} pictures is changed"
    shares, most = sorted(change.pixels_changed / change.pixels for change in changes), max(c.largest for c in changes)
    many = f"{len(changes)} of {len(done.views)} pictures are changed, {shares[0]:.1%} to {shares[-1]:.1%} of each"
    return f"{many}, a channel by at most {round(most * 255)} of 255"


def _object(
    config: ObjectConfig, views: Dataset, splat: GaussianScene | None
) -> tuple[GaussianScene, Tensor, float, dict[str, Any]]:
    """The splat, (N,) bool, its Gaussians that are the object, its near plane, and what the record says of these."""
    from mi_splat.bounds import near_plane
    from mi_splat.rendering import Renderer, RenderSettings
    from mi_splat.scene import scene_hash
    from mi_splat.selection.select import select

    assert splat is not None
    if config.picture >= len(views):
        do = "count from 0"
        raise InvalidValueError(message("--picture", f"a number below {len(views)}", config.picture, do))
    near = near_plane(splat, views.cameras)
    camera, render = views.cameras[config.picture], Renderer(RenderSettings(near=near))
    rows = select(splat, config.selection, camera=camera, render=render)
    selected = {"selection": config.selection.as_dict(), "scene_hash": scene_hash(splat), "gaussians": int(rows.sum())}
    return splat, rows, near, selected
