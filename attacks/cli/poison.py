"""`mi-splat poison`: an attack on a set of anybody's images, and so on every splat that
is trained on it.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple

from attacks.cli.options import Detectors
from attacks.poisons.specs import POISONS, Given
from mi_splat.cli.console import UsageError, follow, progress, show_result, warn
from mi_splat.cli.flags import Flag, Positional, choice_among
from mi_splat.cli.options import (
    Direction,
    ResultOptions,
    axis_name,
    check_no_input_in,
    up_line,
)
from mi_splat.errors import InvalidValueError
from mi_splat.fields import Metavar, Seed, Steps, at_least, between
from mi_splat.selection.config import Selection

if TYPE_CHECKING:
    from torch import Tensor

    from attacks.classifiers.base import Classifier
    from attacks.poisons.base import Masks, OnStep, Poisoned
    from attacks.poisons.poison_splat import Decoy
    from mi_splat.cameras.camera import Camera
    from mi_splat.datasets import Dataset
    from mi_splat.scene import GaussianScene

EXAMPLES = (
    (
        "poison YOUR_PHOTOS out/photos/splat.ply --click 320,240 --hide-from"
        " elevation:50-90 --out out/poisoned"
    ),
    (
        "poison YOUR_PHOTOS out/photos/splat.ply --box -1 -1 0 1 1 1 --hide-from"
        " cone:180,30,25 --appearance stop.png"
    ),
    (
        "poison YOUR_PHOTOS out/photos/splat.ply --kind poison-splat --eps 16 --steps"
        " 2000 --out out/swollen"
    ),
    (
        "poison YOUR_PHOTOS out/photos/splat.ply --kind m-ifgsm --label car --click"
        " 320,240 --out out/misread"
    ),
    "poison YOUR_PHOTOS --kind uniform-noise --eps 16 --out out/noise",
)


@dataclass(frozen=True, kw_only=True)
class ObjectConfig:
    """An object of the images.

    Attributes:
        selection: Which Gaussians of the splat are the object.
        image: Index of the training image that --click refers to.
        detectors: Names of the detectors that find the object for --detect.
    """

    selection: Selection = field(default_factory=Selection)
    image: Annotated[int, at_least(0), Metavar("NUMBER")] = 0
    detectors: Detectors = ("fasterrcnn_small",)


@dataclass(frozen=True, kw_only=True)
class HidingConfig(ObjectConfig):
    """CLOAK on a set of images.

    Attributes:
        hide_from: Directions from the object's centre in which it is hidden, in
            degrees: elevation:LOW-HIGH, azimuth:LOW-HIGH or
            cone:AZIMUTH,ELEVATION,HALF_ANGLE around a direction; several regions are
            intersected.
        margin: Degrees around that region in which images are changed, too.
        appearance: Appearance shown instead of the object: background (what other
            photographs show behind it, by a splat without the object, so that all
            images agree), remove (each image is inpainted on its own), or an image
            file.
        reach: Pixels around the object that change, too.
        background_steps: Training steps of the splat without the object, for
            background.
        up: Up direction of the set's world: an axis, or X,Y,Z. Default: estimated from
            its cameras, as `mi-splat info SET` prints it.
    """

    hide_from: tuple[Annotated[str, Metavar("REGION")], ...] = ("elevation:50-90",)
    margin: Annotated[
        float, between(0, 90, "degrees", "7 hides more, and begins to show before")
    ] = 0.0
    appearance: Annotated[str, Metavar("APPEARANCE")] = "remove"
    reach: Annotated[int, between(0, 100, "pixels")] = 3
    background_steps: Steps = 600
    up: Direction | None = None


@dataclass(frozen=True, kw_only=True)
class AimedConfig(ObjectConfig):
    """A poison of an object of a set of images.

    Attributes:
        attack: How the object's pixels are changed.
    """

    attack: Any = None


@dataclass(frozen=True, kw_only=True)
class MisreadingConfig(AimedConfig):
    """A poison that makes a classifier misread an object.

    Attributes:
        classifier: Who shall misread the object: prototypes, or torchvision:NETWORK.
        label: The object's true class, by a name that the classifier knows.
    """

    classifier: Annotated[str, Metavar("CLASSIFIER")] = "prototypes"
    label: Annotated[str | None, Metavar("CLASS")] = None


class Outcome(NamedTuple):
    """A poisoned set, what else its record says, and in words what the user should
    know.
    """

    done: Poisoned
    record: Mapping[str, Any] = MappingProxyType({})
    lines: Sequence[str] = ()
    warnings: Sequence[str] = ()


Work = Callable[["Dataset", "GaussianScene | None", "OnStep"], Outcome]
"""Poisons the images for training; takes the splat if the kind needs one."""


@dataclass(frozen=True, kw_only=True)
class Kind:
    """A kind of poison: its options, and what checks them and returns the work."""

    config: Any
    prepare: Callable[[Any, PoisonOptions], Work]
    needs_splat: bool = True
    on_gpu: bool = False
    replaces: bool = False


def kind_names() -> list[str]:
    """Names of all kinds; another package's poison is imported when its kind is asked
    for.
    """
    return list(dict.fromkeys(["cloak", *POISONS]))


@dataclass(frozen=True, kw_only=True)
class PoisonOptions(ResultOptions):
    """Poison a set of images with cameras, so that the trained splat hides an object,
    is larger, or is misclassified.

    Writes a set with the same cameras into --out, some of whose images are poisoned.
    Images keep their names, and JPEG files stay JPEG where cloak changes them. A victim
    trains on it as on any other set. poison.json and before_and_after.png record what
    was changed. Held-out images are not changed, so that the splat can be compared with
    them.

    Kinds: cloak shows something else instead of an object, in the images from
    --hide-from. poison-splat makes a splat take more Gaussians, memory and time;
    uniform-noise and raised-variation are its controls, and need no splat. m-ifgsm
    perturbs an object in each image, so that a classifier misclassifies it.
    """

    dataset: Annotated[Positional[Path], Metavar("SET")]
    """Folder of images with cameras (transforms.json or COLMAP), or its transforms
    file.
    """
    splat: Annotated[Path | None, Flag(positional=True), Metavar("SPLAT")] = None
    """Splat trained on the set, used to locate the object and to initialise
    poison-splat.
    """
    kind: Annotated[str, Metavar("|".join(kind_names()))] = "cloak"
    """Which attack. For the flags of one add --help."""
    poison: Any = field(default_factory=HidingConfig)
    """How the images are changed."""
    downscale: Annotated[int, at_least(1)] = 1
    """Image downscale factor."""
    device: Literal["cpu", "cuda"] = "cpu"
    """Device for the proxy splat (poison-splat) and the classifier (m-ifgsm): the CPU
    or an NVIDIA GPU.
    """
    seed: Seed = 0
    """Random seed; cloak uses it only for the order of photographs for --appearance
    background.
    """


def defaults(words: Sequence[str]) -> dict[str, Any]:
    """The kind and its options, which say what further flags there are, and whether a
    splat is needed.
    """
    name = choice_among(kind_names(), words, "--kind", "cloak")
    kind = kind_of(name)
    return {
        "kind": name,
        "poison": kind.config,
        "splat": dataclasses.MISSING if kind.needs_splat else None,
    }


def run(options: PoisonOptions) -> None:
    """Poison the set, and say how many images were changed and how much."""
    from attacks.cloak.own_pictures import BEFORE_AND_AFTER, RECORD, before_and_after
    from attacks.poisons.writing import (
        as_files_hold,
        difference_sheet,
        names_as_before,
        write_poisoned,
    )
    from mi_splat import provenance
    from mi_splat.datasets import load_dataset
    from mi_splat.datasets.transforms import PARTS, find_transforms
    from mi_splat.io import load_splat
    from mi_splat.io.documents import save_json, save_png
    from mi_splat.io.folders import check_new_folder, new_folder
    from mi_splat.render.variant import check_device

    kind = kind_of(options.kind)
    if options.device != "cpu" and not kind.on_gpu:
        able = " or ".join(name for name in kind_names() if kind_of(name).on_gpu)
        raise UsageError.of(
            f"--device {options.device}", f"--kind {able}", options.kind, "leave it out"
        )
    check_device(options.device)
    check_no_input_in(options.out, options.dataset, options.splat)
    check_new_folder(options.out, force=options.force, record=RECORD)
    work = kind.prepare(options.poison, options)
    with progress("reading the set"):
        views = load_dataset(
            options.dataset, split="train", downscale=options.downscale
        )
        held_out = load_dataset(
            options.dataset, split="test", downscale=options.downscale
        )
        if kind.needs_splat and options.splat is not None:
            splat = load_splat(options.splat)
        else:
            splat = None
    with progress("poisoning", total=None) as advance:
        on_step = follow(advance)
        done, more, lines, warnings = work(
            views, splat, lambda count, total: on_step("poisoning", count, total)
        )
        done = as_files_hold(done, views)
        names = names_as_before(views, held_out, is_lossy=kind.replaces)
        found = find_transforms(options.dataset)
        is_split = found is not None and found.name in PARTS.values()
        record: dict[str, Any] = {
            "set": str(options.dataset),
            "splat": None if splat is None else str(options.splat),
            "downscale": options.downscale,
            "device": options.device,
            **more,
            **done.manifest,
            "changed_images": [names["train"][one.index] for one in done.changes],
            "footprint": _footprint(done),
            **provenance.origin(),
        }
        advance("writing")
        with new_folder(options.out, force=options.force, record=RECORD) as folder:
            write_poisoned(
                folder,
                views,
                done,
                held_out=held_out,
                changes_count=kind.replaces,
                keeps_alpha=True,
                names=names,
                is_single=not is_split,
            )
            save_png(
                (before_and_after if kind.replaces else difference_sheet)(done),
                folder / BEFORE_AND_AFTER,
            )
            save_json(record, folder / RECORD)
    for text in warnings:
        warn(text)
    last = f"{options.out}: train on it as on any set; {RECORD} says what was changed"
    show_result(
        {**record, "out": str(options.out)},
        _changes(done),
        *lines,
        last,
        as_json=options.json,
    )


def _footprint(done: Poisoned) -> dict[str, float]:
    """The share of the training images, and of their pixels, that changed."""
    changes = [change for change in done.changes if change.pixels_changed]
    pixels = sum(camera.width * camera.height for camera in done.views.cameras)
    changed = sum(change.pixels_changed for change in changes)
    return {"images": len(changes) / len(done.views), "pixels": changed / pixels}


def _changes(done: Poisoned) -> str:
    changes = [change for change in done.changes if change.pixels_changed]
    if not changes:
        return f"none of {len(done.views)} images is changed"
    shares = sorted(change.pixels_changed / change.pixels for change in changes)
    most = max(c.largest for c in changes)
    footprint = _footprint(done)
    many = (
        f"{len(changes)} of {len(done.views)} training images are changed"
        f" ({footprint['images']:.1%}), {shares[0]:.1%} to {shares[-1]:.1%} of each and"
        f" {footprint['pixels']:.2%} of all training pixels"
    )
    return f"{many}, a channel by at most {round(most * 255)} of 255"


def _hiding(config: HidingConfig, options: PoisonOptions) -> Work:
    from attacks.cloak.own_pictures import (
        BACKGROUND,
        appearance_of,
        background_of,
        directions_of,
        hide,
    )
    from attacks.cloak.triggers import trigger_of
    from mi_splat.datasets import load_dataset

    trigger = trigger_of(config.hide_from, margin=config.margin)
    fixed = None
    if config.appearance != BACKGROUND:
        fixed = appearance_of(config.appearance, config.reach)

    def work(views: Dataset, splat: GaussianScene | None, on_step: OnStep) -> Outcome:
        assert splat is not None
        rows, near, selected = _object(config, views, splat)
        if config.up is None:
            guess = load_dataset(options.dataset, split=None).up
            up = guess.direction
            line = up_line(guess)
        else:
            up = config.up
            line = f"up is {axis_name(up)}"
        appearance = fixed or background_of(
            views,
            splat,
            rows,
            near=near,
            reach=config.reach,
            up=up,
            steps=config.background_steps,
            seed=options.seed,
            on_step=on_step,
        )
        done = hide(
            views,
            splat,
            rows,
            trigger,
            appearance,
            near=near,
            up=up,
            on_step=on_step,
        )
        directions = [
            [direction.azimuth, direction.elevation]
            for direction in directions_of(done)
        ]
        settings = {
            "hide_from": list(config.hide_from),
            "margin": config.margin,
            "appearance": config.appearance,
        }
        settings |= {"reach": config.reach, "directions": directions}
        if fixed is None:
            settings["background_steps"] = config.background_steps
            settings["seed"] = options.seed
        idle = sum(not change.pixels_changed for change in done.changes)
        remark = (
            f"{idle} images from where it is to be hidden do not show the object, and"
            " stay as they are"
        )
        return Outcome(
            done,
            {**selected, **settings},
            [line],
            [remark] * (idle > 0),
        )

    return work


def _resolved(config: Any, options: PoisonOptions) -> Work:
    """A poison of the registry, which is given what it needs."""
    spec = POISONS[options.kind]
    settings = config.attack if isinstance(config, AimedConfig) else config
    classifier = None
    label = ""
    if isinstance(config, MisreadingConfig):
        classifier, label = _deceived(config)

    def work(views: Dataset, splat: GaussianScene | None, on_step: OnStep) -> Outcome:
        from attacks.poisons.judged import move

        masks: Masks | None = None
        selected: dict[str, Any] = {}
        if isinstance(config, AimedConfig):
            assert splat is not None
            rows, near, selected = _object(config, views, splat)
            masks = _masks_of(splat, rows, near, views)
        if classifier is not None:
            move(classifier, options.device)
        decoy = None
        steps_of_decoy: int = getattr(settings, "decoy_steps", 0)
        if "splat" in spec.needs or steps_of_decoy:
            assert splat is not None
            decoy = _decoy(splat, views, options.device)
        given = Given(decoy=decoy, masks=masks, classifier=classifier, label=label)
        done = spec.make(settings, given)(views, seed=options.seed, on_step=on_step)
        return Outcome(
            done, selected, lines=_growth(done), warnings=_skipped(done, config)
        )

    return work


def _deceived(config: MisreadingConfig) -> tuple[Classifier, str]:
    """The classifier that is to be deceived, and the object's true class."""
    from attacks.classifiers.frozen import class_number
    from attacks.classifiers.registry import load_classifier

    if config.label is None:
        raise UsageError.of("--label", "the class of the object", "none", "add it")
    classifier = load_classifier(config.classifier)
    class_number(classifier, config.label, "--label")
    target = getattr(config.attack, "target", None)
    if target is not None:
        class_number(classifier, target, "--target")
    return classifier, config.label


def _masks_of(
    splat: GaussianScene, rows: Tensor, near: float, views: Dataset
) -> Callable[[Camera], Tensor]:
    """Where the object is in the image of a camera of the set."""
    from mi_splat.render.renderer import Renderer, RenderSettings
    from mi_splat.render.variant import DEFAULT_VARIANT
    from mi_splat.selection.select import SEEN
    from mi_splat.selection.visibility import object_weight

    render = Renderer(RenderSettings(near=near, variant=DEFAULT_VARIANT))
    names = dict(zip(map(id, views.cameras), views.paths, strict=True))

    def mask(camera: Camera) -> Tensor:
        seen = object_weight(splat, rows, camera, render) >= SEEN
        if not bool(seen.any()):
            what = str(names.get(id(camera), camera))
            do = "select all of the object, or leave the image out of the set"
            raise InvalidValueError.of(what, "some pixels of the object", "none", do)
        return seen

    return mask


def _growth(done: Poisoned) -> list[str]:
    """How large the decoy has grown, where the poison has one that grows."""
    grown = done.poison.get("decoy_gaussians")
    start = done.poison.get("start_gaussians")
    if not grown:
        return []
    return [f"the decoy has {grown:,} Gaussians, the splat has {start:,}"]


def _skipped(done: Poisoned, config: Any) -> list[str]:
    """Images that stay because the classifier does not read them rightly."""
    skipped = len(done.poison.get("skipped", ()))
    if not skipped or not isinstance(config, MisreadingConfig):
        return []
    sure: float | None = getattr(config.attack, "least_confidence", None)
    if sure is None:  # of another package
        return []
    return [
        f"in {skipped} images {config.classifier} is less than {sure:.0%}"
        f" confident of {config.label}; they stay"
    ]


_CLOAK = Kind(config=HidingConfig(), prepare=_hiding, replaces=True)


def kind_of(name: str) -> Kind:
    """A kind by its name."""
    if name == "cloak":
        return _CLOAK
    spec = POISONS[name]
    if "scene" in spec.needs:
        expected = "one that needs no scene of meshes"
        raise UsageError.of(f"--kind {name}", expected, "a scene", "write a study")
    config = spec.config()
    if "classifier" in spec.needs:
        config = MisreadingConfig(attack=config)
    elif "object" in spec.needs:
        config = AimedConfig(attack=config)
    return Kind(
        config=config,
        prepare=_resolved,
        needs_splat=bool(spec.needs),
        # decoys and classifiers take most of the time
        on_gpu="splat" in spec.needs or "classifier" in spec.needs,
    )


def _decoy(splat: GaussianScene, views: Dataset, device: str) -> Decoy:
    """A decoy that starts as the splat, on a device; the victim is taken to train as
    usual.
    """
    from attacks.poisons.poison_splat import Decoy
    from mi_splat.cameras.framing import near_plane

    near = near_plane(splat, views.cameras)
    return Decoy(start=splat.to(device), near=near, background=views.background)


def _object(
    config: ObjectConfig, views: Dataset, splat: GaussianScene
) -> tuple[Tensor, float, dict[str, Any]]:
    """(N,) bool, the object's Gaussians, the near plane of the splat, and what the
    record says of these.
    """
    from attacks.cli.options import box_finder
    from mi_splat.cameras.framing import near_plane
    from mi_splat.cli.sources import find_in_images, photographs
    from mi_splat.render.renderer import Renderer, RenderSettings
    from mi_splat.scene import scene_hash
    from mi_splat.selection.select import select

    if config.image >= len(views):
        do = "count from 0"
        raise InvalidValueError.of(
            "--image", f"a number below {len(views)}", config.image, do
        )
    near = near_plane(splat, views.cameras)
    camera = views.cameras[config.image]
    render = Renderer(RenderSettings(near=near))
    found = None
    if config.selection.needs_images:
        found = find_in_images(
            splat,
            photographs(views),
            config.selection,
            render=render,
            find_boxes=box_finder(config.detectors),
        ).mask
    rows = select(splat, config.selection, camera=camera, render=render, found=found)
    selected = {
        "selection": config.selection.as_dict(),
        "scene_hash": scene_hash(splat),
        "gaussians": int(rows.sum()),
    }
    return rows, near, selected
