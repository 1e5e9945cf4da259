"""`mi-splat dagger`: attack one object of a scene, from chosen cameras or all of a
region.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from attacks.cli.options import (
    DEFAULT_OBJECT,
    DEFAULT_TARGET,
    ClassName,
    Confidence,
    DetectorOptions,
)
from attacks.dagger.config import (
    NARROW_CHANGES,
    DaggerConfig,
    narrow_defaults,
    region_defaults,
    views_defaults,
)
from attacks.objectives import OBJECTIVES, objective_of
from attacks.transformations.config import (
    CameraCone,
    CameraRegion,
    ImageTransformations,
    Transformations,
)
from mi_splat.cli.console import Advance, limit_threads, progress, warn
from mi_splat.cli.flags import Positional
from mi_splat.cli.options import CameraOptions, ResultOptions, check_no_input_in
from mi_splat.errors import InvalidValueError
from mi_splat.fields import Metavar, OutFolder, Share, between
from mi_splat.processes import deferred_interrupt
from mi_splat.selection.config import Selection

if TYPE_CHECKING:
    from torch import Tensor

    from attacks.dagger.views import FixedViews
    from attacks.detectors.base import Detector
    from attacks.objectives.base import Objective
    from attacks.search.loop import Step
    from mi_splat.cli.cameras import Chosen
    from mi_splat.datasets.frames import Split
    from mi_splat.render.scene_files import SplatScene

EXAMPLES = (
    "dagger scenes/car_street.xml --object car --target person --out out/dagger",
    "dagger scenes/car_street.xml --objective hide --object-psnr 38 --out out/hidden",
    (
        "dagger scenes/car_street.xml --object car --cameras rear --around 10 --ladder"
        " 35 32 29 --out out/narrow"
    ),
    (
        "dagger YOUR.ply --mask mask.npy --cameras orbit:4@25 --target person --out"
        " out/desk"
    ),
    (
        "dagger --region scenes/car_street.xml --object car --target person --out"
        " out/dagger-eot"
    ),
    (
        "dagger --region scenes/car_street.xml --object car --elevations 10 30 --jpeg"
        " 50 --blur 1 --out out/photographed"
    ),
    "demo",
    "demo --out out/first --force",
)


_BUDGET = ("attributes", "eps", "norm", "image_psnr", "object_psnr")
"""Settings on which the defaults of the others depend."""


def _budget_in(words: Sequence[str]) -> dict[str, Any]:
    """What the user's words say of the budget, read before all other flags."""
    return _said(words, _BUDGET)


def _said(words: Sequence[str], names: Sequence[str]) -> dict[str, Any]:
    """The values of some flags among the user's words, but for none."""
    given = dict[str, list[str]]()
    flag = ""
    for word in words:
        if word.startswith("--"):
            flag, equals, value = word.removeprefix("--").partition("=")
            flag = flag.replace("-", "_")
            given[flag] = [value] if equals else []
        elif flag:
            given[flag].append(word)
    said = {name: given[name] for name in names if name in given}
    return {name: values for name, values in said.items() if values != ["none"]}


@dataclass(frozen=True, kw_only=True)
class AttackOptions(DetectorOptions, ResultOptions):
    """What an attack on one object takes, from chosen cameras or from a region."""

    scene: Positional[Path]
    """Scene XML made of splats, a splat file, or example:car_street or
    example:stop_sign.
    """
    selection: Selection = field(default_factory=Selection)
    """The object whose Gaussians are attacked; all others stay unchanged. By default
    the part named car.
    """
    view: CameraOptions = field(default_factory=CameraOptions)
    """Camera region."""
    objective: Annotated[str, Metavar("relabel|hide|untargeted")] = "relabel"
    """Objective: relabel as another class (--target), hide from detection, untargeted
    misclassification, or one registered by a plug-in.
    """
    target: ClassName | None = None
    """Target class (relabel). Default: person."""
    device: Literal["cpu", "cuda"] = "cpu"
    """Device for splat and detectors: the CPU, or an NVIDIA GPU, where results are not
    bit-reproducible.
    """
    confidence: Confidence | None = None
    """Confidence that counts as success: at least this for the target class, or less
    than this for the object to hide. Default: the operating threshold of each detector
    (0.7 with --no-strict) for the target class; 0.3, or that threshold if it is lower,
    for hiding.
    """
    strict: bool = True
    """Whether a relabelled object counts only if its original class falls below the
    operating threshold, or below 0.5 with --confidence. --no-strict: count a relabelled
    object even if its original class is still reported. --no-strict --eps 5
    --step-factor 2 --momentum 0 --schedule constant is the search of the paper.
    """


@dataclass(frozen=True, kw_only=True)
class DaggerOptions(AttackOptions):
    """Perturb the Gaussians of one object within a budget until a detector
    misclassifies it (DAGGER).

    Writes before.png, after.png, difference.png, detections.png, attacked.ply, mask.npy
    (the object), cameras.json, the rows and result.json into --out; of a scene XML also
    attacked.xml with its parts, which can be rendered and attacked again. The exit
    status is 0 also when the attack fails: that is a result.

    With --around the attack covers all cameras near the chosen one, and image
    transformations. It is evaluated on held-out cameras without transformations
    (held_out.png).
    """

    view: CameraOptions = field(default_factory=CameraOptions)
    """The cameras attacked jointly; one by default. For the folder of a set: those of
    the training images that show the object, so that the held-out ones remain for
    evaluation.
    """
    around: Annotated[float, between(0, 60, "degrees"), Metavar("DEGREES")] | None = (
        None
    )
    """Attack all cameras within this angle of the chosen one, as seen from the middle
    of the object. The defaults are then those of a robust, less visible attack: 36 dB
    on the object, at most 6 dB less on any part of it, and random image transformations
    (--jpeg, --blur, --resize, --sizes).
    """
    around_distance: Share = 0.1
    """Largest change of these cameras' distance, as a fraction of that of the chosen
    one.
    """
    images: ImageTransformations = field(default_factory=ImageTransformations)
    """Random image transformations between renderer and detector during the search with
    --around.
    """
    config: DaggerConfig = field(default_factory=DaggerConfig.for_views)
    """Search and budget. The perturbation budget is the PSNR of the object's pixels
    (--object-psnr); with --eps, or if attributes other than colours change, it is a
    ball of radius eps.
    """
    out: OutFolder = Path("out/dagger")

    @staticmethod
    def defaults(words: Sequence[str]) -> dict[str, Any]:
        """The settings that depend on the budget, and on whether one camera is attacked
        or all around it.
        """
        budget = _budget_in(words)
        if _said(words, ["around"]):
            return {
                "config": DaggerConfig(**narrow_defaults(budget)),
                "images": ImageTransformations(**NARROW_CHANGES),
            }
        return {"config": DaggerConfig(**views_defaults(budget))}

    def __post_init__(self) -> None:
        if self.around is None and self.images != ImageTransformations():
            raise InvalidValueError.of(
                "changes of images (--jpeg, --blur, ...)",
                "--around as well",
                "a chosen camera",
                "pass --around 10, or leave them out",
            )


@dataclass(frozen=True, kw_only=True)
class DaggerRegionOptions(AttackOptions):
    """Perturb one object so that detectors misclassify it from all cameras of a region,
    not from one (DAGGER with EOT).

    Views are drawn at random, new ones at each step or from a pool; the result is
    evaluated on held-out views. Writes held_out.png, attacked.ply, mask.npy (the
    object), cameras.json, the rows and result.json into --out; of a scene XML also
    attacked.xml with its parts. The exit status is 0 also when the attack fails: that
    is a result.
    """

    view: CameraOptions = field(default_factory=CameraOptions)
    """The reference camera, the first if there are several: it sets image size, field
    of view and the unit of distances.
    """
    region: CameraRegion = field(default_factory=CameraRegion)
    """Camera region."""
    images: ImageTransformations = field(default_factory=ImageTransformations)
    """Random image transformations between renderer and detector; none by default."""
    config: DaggerConfig = field(default_factory=DaggerConfig.for_region)
    """How to attack."""
    out: OutFolder = Path("out/dagger-eot")

    @staticmethod
    def defaults(words: Sequence[str]) -> dict[str, Any]:
        """The settings that depend on which budget is asked for."""
        return {"config": DaggerConfig(**region_defaults(_budget_in(words)))}


@dataclass(frozen=True, kw_only=True)
class DemoOptions(ResultOptions):
    """Attack the car of the scene example:car_street, so that a small Faster R-CNN
    reports a person in its place.

    The same as `mi-splat dagger example:car_street --object car --target person
    --cameras rear`. It needs neither a GPU nor a network, and takes about 20 seconds on
    two CPU cores. Writes the same files as `mi-splat dagger` into --out; open
    detections.png first.
    """

    out: OutFolder = Path("out/demo")


def run(options: DaggerOptions) -> None:
    """Attack from chosen cameras; Ctrl-C ends the search with the best so far."""
    from attacks.dagger.views import FixedViews
    from mi_splat.selection.select import require_visible

    if options.around is not None:
        run_around(options, options.around)
        return
    config = options.config
    with progress(
        "loading the scene and the detector", total=config.restarts * (config.steps + 1)
    ) as advance:
        loaded, selection, chosen = _opened(options, split="train")
        weights = chosen.weights(loaded)
        if any(Path(text).is_dir() for text in options.view.cameras):
            chosen, weights = _showing(chosen, weights)
        require_visible(weights)
        cameras = list(chosen.cameras.values())
        views = FixedViews(
            loaded.scene, chosen.mask, cameras, render=chosen.render, up=chosen.up
        )
        origin = {"selection": selection.as_dict(), "cameras": list(chosen.cameras)}
        told = tuple(chosen.doubts(weights, chosen.agreement(loaded)))
        interrupted = _attack(options, loaded, chosen, views, origin, advance, told)
    _end(options, interrupted)


def run_around(options: DaggerOptions, angle: float) -> None:
    """Attack from all cameras around a chosen one."""
    cone = CameraCone(angle=angle, margin=options.around_distance)
    drawn = Transformations(cameras=cone, images=options.images)
    _run_drawn(options, drawn, drawn.plain)


def run_region(options: DaggerRegionOptions) -> None:
    """Attack from all cameras of a region."""
    drawn = Transformations(cameras=options.region, images=options.images)
    _run_drawn(options, drawn, drawn)


def _run_drawn(
    options: DaggerOptions | DaggerRegionOptions,
    drawn: Transformations,
    evaluation: Transformations,
) -> None:
    """Attack from drawn cameras; Ctrl-C ends the search with the best so far."""
    from attacks.dagger.views import DrawnViews
    from mi_splat.io.camera_records import describe

    steps = sum(level.steps + 1 for level in options.config.levels)
    with progress("loading the scene and the detectors", total=steps) as advance:
        loaded, selection, chosen = _opened(options)
        name, camera = next(iter(chosen.cameras.items()))
        views = DrawnViews(
            loaded.scene, chosen.mask, camera, drawn, render=chosen.render, up=chosen.up
        )
        origin = {
            "selection": selection.as_dict(),
            "cameras": [name],
            "reference": describe(name, camera),
        }
        held_out = views if evaluation == drawn else views.drawn_from(evaluation)
        interrupted = _attack(
            options, loaded, chosen, views, origin, advance, evaluation=held_out
        )
    _end(options, interrupted)


def run_demo(options: DemoOptions) -> None:
    """Attack with the options of the demo."""
    from attacks.cli import parse

    words = [
        "example:car_street",
        "--object",
        "car",
        "--target",
        "person",
        "--cameras",
        "rear",
        "--out",
    ]
    flags = [f"--{name}" for name in ("force", "json") if getattr(options, name)]
    run(parse("dagger", [*words, str(options.out), *flags]))


def _opened(
    options: AttackOptions, *, split: Split | None = None
) -> tuple[SplatScene, Selection, Chosen]:
    """The scene, what is selected in it, and the object with its cameras, if --out can
    be written.
    """
    from attacks.cli.options import box_finder
    from mi_splat.cli.cameras import choose
    from mi_splat.io.folders import check_new_folder
    from mi_splat.render.scene_files import open_scene

    check_no_input_in(options.out, options.scene)
    check_new_folder(options.out, force=options.force)
    limit_threads()
    loaded = open_scene(options.scene, options.device)
    selection = options.selection
    if selection.is_empty and DEFAULT_OBJECT in loaded.objects:
        selection = replace(selection, object=DEFAULT_OBJECT)
    find_boxes = box_finder(options.detectors, options.weights, options.device)
    chosen = choose(loaded, selection, options.view, split=split, find_boxes=find_boxes)
    return loaded, selection, chosen


def _detectors_and_objective(
    options: DaggerOptions | DaggerRegionOptions,
) -> tuple[Sequence[Detector], Objective]:
    from attacks.cli.options import load_detectors

    targeted = OBJECTIVES.chosen(options.objective).targeted
    target = (options.target or DEFAULT_TARGET) if targeted else None
    detectors = load_detectors(options.detectors, options.weights, options.device)
    objective = objective_of(
        options.objective,
        target,
        options.confidence,
        strict=options.strict,
        quiet=options.config.object_psnr is not None,
    )
    return detectors, objective


def _attack(
    options: DaggerOptions | DaggerRegionOptions,
    loaded: SplatScene,
    chosen: Chosen,
    views: FixedViews,
    origin: dict[str, Any],
    advance: Advance,
    doubts: tuple[str, ...] = (),
    evaluation: FixedViews | None = None,
) -> bool:
    """Attack and write the result, the mask, and of a scene file its parts; whether
    Ctrl-C ended the search.
    """
    from attacks.dagger.attack import attack_views
    from attacks.dagger.report import write_files
    from mi_splat.io.folders import new_folder
    from mi_splat.render.scene_files import write_scene
    from mi_splat.selection.select import save_mask

    detectors, objective = _detectors_and_objective(options)
    advance("attacking", 0)
    with deferred_interrupt() as interrupted:
        on_step = _follow(advance, objective.label, options.config, interrupted)
        result = attack_views(
            views,
            detectors,
            objective,
            config=options.config,
            evaluation=evaluation,
            on_step=on_step,
        )
    origin = {**result.origin, "scene": str(options.scene), **origin}
    result = replace(result, origin=origin, doubts=doubts)
    with new_folder(options.out, force=options.force) as folder:
        save_mask(chosen.mask, folder / "mask.npy")
        if loaded.cameras:  # a bare splat has none, and so makes no scene file
            write_scene(loaded, result.scene, folder / "attacked.xml")
        write_files(result, folder)
    return interrupted()


def _end(options: AttackOptions, interrupted: bool) -> None:
    """Show what came of it, and end as Ctrl-C does if it was given."""
    from attacks.cli.summary import show_summary

    show_summary(options.out, as_json=options.json)
    if interrupted:
        raise KeyboardInterrupt


def _showing(
    chosen: Chosen, weights: dict[str, Tensor]
) -> tuple[Chosen, dict[str, Tensor]]:
    """The cameras from which the object shows; all if there is none."""
    from mi_splat.selection.select import SEEN

    kept = {
        name: weight for name, weight in weights.items() if bool((weight >= SEEN).any())
    } or weights
    idle = len(weights) - len(kept)
    if idle:
        warn(
            f"{idle} of {len(weights)} images for training do not show the object,"
            " and are left out"
        )
    return replace(chosen, cameras={name: chosen.cameras[name] for name in kept}), kept


def _follow(
    advance: Advance,
    label: str | None,
    config: DaggerConfig,
    interrupted: Callable[[], bool],
) -> Callable[[Step], bool]:
    """Show each step with the last score, and end the attack if the clean object is
    taken for the class wanted.
    """
    from attacks.search.loop import NOT_JUDGED

    score = ""

    def note(step: Step) -> bool:
        nonlocal score
        if (
            label is not None
            and step.index == step.restart == 0
            and step.unambiguous
            and not config.random_start
        ):
            do = "name another class with --target"
            raise InvalidValueError.of(
                "--target", "another class than is seen before the attack", label, do
            )
        score = score if step.score == NOT_JUDGED else f", score {step.score:.0%}"
        advance(f"attacking: loss {step.loss:.3f}{score}")
        return step.index + step.restart > 0 and interrupted()

    return note
