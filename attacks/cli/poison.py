"""`mi-splat poison`: CLOAK on a set of anybody's pictures: the object is hidden in those from chosen directions."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from mi_splat.cli.console import follow, progress, show_result, warn
from mi_splat.cli.flags import Positional, Unprefixed
from mi_splat.cli.options import Direction, ResultOptions, axis_name, check_no_input_in
from mi_splat.errors import InvalidValueError, message
from mi_splat.fields import Called, at_least, between
from mi_splat.selection.config import Selection

if TYPE_CHECKING:
    from torch import Tensor

    from attacks.poisons.base import Poisoned
    from mi_splat.cameras import Camera
    from mi_splat.datasets import Dataset
    from mi_splat.scene import GaussianScene

EXAMPLES = (
    "poison my_photos out/photos/splat.ply --click 320,240 --hide-from elevation:50-90 --out out/poisoned",
    "poison my_photos out/photos/splat.ply --box -1 -1 0 1 1 1 --hide-from cone:180,30,25 --look stop.png",
)
SEE_ALSO = ("train", "select", "report", "cloak")


@dataclass(frozen=True, kw_only=True)
class PoisonOptions(ResultOptions):
    """Poison a set of pictures with cameras, so that a splat that is trained on it hides an object from some sides.

    Writes a set of the same cameras into --out: pictures from --hide-from show something else in the place of the
    object, all others are the same. A victim trains on it as on any other. poison.json says what was changed, and
    mi-splat report shows it. Pictures that are held out stay as they are, so that the splat can be compared with them.
    """

    dataset: Positional[Path]
    """Folder of pictures with cameras (transforms.json or COLMAP), or its transforms file."""
    splat: Positional[Path]
    """A splat that was trained on the set; by it the object is found in each picture."""
    selection: Unprefixed[Selection] = field(default_factory=Selection)
    """Which Gaussians of the splat are the object."""
    picture: Annotated[int, at_least(0), Called("NUMBER")] = 0
    """Which of the pictures for training --click is on, in their order."""
    hide_from: tuple[Annotated[str, Called("REGION")], ...] = ("elevation:50-90",)
    """Where the object is hidden, seen from its middle, in degrees: elevation:LOW-HIGH, azimuth:LOW-HIGH or
    cone:AZIMUTH,ELEVATION,HALF_ANGLE, which is around a direction; of several, from where all of them hold."""
    margin: Annotated[float, between(0, 90, "degrees", "7 hides more, and begins to show before")] = 0.0
    """Degrees around it in which pictures are changed, too."""
    look: Annotated[str, Called("LOOK")] = "remove"
    """What is shown in its place: remove (the picture around it goes on), or a picture file."""
    reach: Annotated[int, between(0, 100, "pixels")] = 3
    """Pixels around the object that change, too."""
    up: Direction = (0.0, 0.0, 1.0)
    """Direction that is up in the set's world: an axis, or three numbers; sets of COLMAP often have -y."""
    downscale: Annotated[int, at_least(1)] = 1
    """The pictures are made so many times smaller."""


def run(options: PoisonOptions) -> None:
    """Poison the set, and say how many pictures were changed and from where."""
    import torch

    from attacks.cloak.own_pictures import RECORD, appearance_of, directions_of, hide, trigger_of
    from mi_splat import provenance
    from mi_splat.bounds import near_plane
    from mi_splat.datasets import load_dataset
    from mi_splat.io import load_splat
    from mi_splat.io.folders import check_new_folder
    from mi_splat.rotation import from_z
    from mi_splat.scene import scene_hash

    check_new_folder(options.out, force=options.force, record=RECORD)
    check_no_input_in(options.out, options.dataset, options.splat)
    trigger = trigger_of(options.hide_from, margin=options.margin)
    appearance = appearance_of(options.look, options.reach)
    with progress("reading the set"):
        views = load_dataset(options.dataset, split="train", downscale=options.downscale)
        splat = load_splat(options.splat)
        near = near_plane(splat, views.cameras)
        rows = _selected(splat, options, views, near)
    with progress("poisoning", total=None) as advance:
        told = follow(advance)
        done = hide(
            views,
            splat,
            rows,
            trigger,
            appearance,
            near=near,
            turn=from_z(torch.tensor(options.up)).T,
            on_step=lambda count, total: told("poisoning", count, total),
        )
        record: dict[str, Any] = {
            "set": str(options.dataset),
            "splat": str(options.splat),
            "selection": options.selection.as_dict(),
            "scene_hash": scene_hash(splat),
            "gaussians": int(rows.sum()),
            "hide_from": list(options.hide_from),
            "margin": options.margin,
            "look": options.look,
            "reach": options.reach,
            "up": list(options.up),
            "downscale": options.downscale,
            **done.manifest,
            "directions": [[one.azimuth, one.elevation] for one in directions_of(done)],
            **provenance.origin(),
        }
        advance("writing")
        _write(options, views, done, record)
    shares = sorted(change.pixels_changed / change.pixels for change in done.changes if change.pixels_changed)
    if idle := len(done.changes) - len(shares):
        warn(f"{idle} pictures from where it is to be hidden do not show the object, and stay as they are")
    lines = (
        f"{len(shares)} of {len(views)} pictures are changed, {shares[0]:.1%} to {shares[-1]:.1%} of each",
        f"up is {axis_name(options.up)}",
        f"{options.out}: train on it as on any set; {RECORD} says what was changed",
    )
    show_result({**record, "out": str(options.out)}, *lines, as_json=options.json)


def _selected(splat: GaussianScene, options: PoisonOptions, views: Dataset, near: float) -> Tensor:
    """(N,) bool, the object's Gaussians."""
    from mi_splat.rendering import Renderer, RenderSettings
    from mi_splat.selection.select import select

    if options.picture >= len(views):
        do = "count from 0"
        raise InvalidValueError(message("--picture", f"a number below {len(views)}", options.picture, do))
    camera: Camera = views.cameras[options.picture]
    render = Renderer(RenderSettings(near=near))
    return select(splat, options.selection, camera=camera, render=render)


def _write(options: PoisonOptions, views: Dataset, done: Poisoned, record: dict[str, Any]) -> None:
    """The set with the changed pictures, whole or not at all."""
    import torch

    from attacks.cloak.own_pictures import BEFORE_AND_AFTER, RECORD, before_and_after, counting
    from mi_splat.cameras import View
    from mi_splat.datasets import has_tests, load_dataset, write_transforms
    from mi_splat.io.documents import save_json, save_png
    from mi_splat.io.folders import new_folder

    parts, changed = [views], {change.index: done.views[change.index].image for change in done.changes}
    if has_tests(options.dataset):
        parts.append(load_dataset(options.dataset, split="test", downscale=options.downscale))
    transparent = views.alpha(0) is not None

    def shown(part: Dataset) -> Iterator[View]:
        for index, view in enumerate(part):
            image = changed.get(index, view.image) if part is views else view.image
            alpha = part.alpha(index) if transparent else None
            image = image if alpha is None else (image / alpha.clamp(min=1 / 255)[..., None]).clamp(0, 1)
            yield View(view.camera, image)

    def alphas() -> Iterator[Tensor]:
        for part in parts:
            for index, camera in enumerate(part.cameras):
                alpha = part.alpha(index)
                yield torch.ones(camera.height, camera.width) if alpha is None else alpha

    def masks() -> Iterator[Tensor | None]:
        for part in parts:
            for index in range(len(part)):
                yield counting(part, index, changed.get(index) if part is views else None)

    with new_folder(options.out, force=options.force, record=RECORD) as folder:
        train, *test = map(shown, parts)
        write_transforms(
            folder,
            train,
            test=test[0] if test else (),
            alphas=alphas() if transparent else None,
            masks=masks(),
            points=views.points,
        )
        save_png(before_and_after(done), folder / BEFORE_AND_AFTER)
        save_json(record, folder / RECORD)
