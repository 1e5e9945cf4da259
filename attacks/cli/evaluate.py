"""`mi-splat evaluate`: a clean and an attacked splat from many cameras, and what
detectors make of both.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from attacks.cli.options import ClassName, Confidence, DetectorOptions, Detectors
from mi_splat import provenance
from mi_splat.cli.console import Advance, progress
from mi_splat.cli.flags import Positional
from mi_splat.cli.options import CameraOptions, ResultOptions, check_no_input_in
from mi_splat.fields import Count, Metavar, OutFolder
from mi_splat.selection.config import Selection

if TYPE_CHECKING:
    from attacks.detectors.base import Detector
    from attacks.observe.observations import Observations
    from attacks.observe.rows import Cell
    from attacks.observe.views import ViewDetections
    from mi_splat.cameras.camera import Camera
    from mi_splat.cli.cameras import Chosen
    from mi_splat.scene import GaussianScene


EXAMPLES = (
    (
        "evaluate scenes/car_street.xml out/narrow/attacked.xml --object car --cameras"
        " rear --target person --conditions standard --out out/survival"
    ),
    (
        "evaluate YOUR.ply out/desk/attacked.ply --cameras hemisphere:24 --target"
        " person --out out/evaluated"
    ),
    (
        "evaluate out/photos/splat.ply out/cloaked/splat.ply --mask mask.npy --cameras"
        " YOUR_SET --size 640 --detectors nanodet_coco --inside azimuth:150-240 --out"
        " out/evaluated"
    ),
)


@dataclass(frozen=True, kw_only=True)
class EvaluateOptions(DetectorOptions, ResultOptions):
    """Render a clean and an attacked splat from many cameras, and compare detections.

    Prints how often the object is detected, missed, or classified as the target, with
    95 % intervals. Use other cameras than those that were attacked. Writes an image of
    both splats side by side for each detector, the rows and result.json into --out.
    """

    clean: Positional[Path]
    """The splat or scene XML before the attack."""
    attacked: Positional[Path]
    """The splat or scene XML after it."""
    selection: Selection = field(default_factory=Selection)
    """The object in the clean splat. By default the Gaussians that differ."""
    view: CameraOptions = field(default_factory=CameraOptions)
    """Cameras for both."""
    original: tuple[ClassName, ...] = ()
    """True class of the object, or several of which any counts. Default: the class that
    each detector reports in most views of the clean splat.
    """
    target: ClassName | None = None
    """Target class of the attack."""
    min_confidence: Confidence | None = None
    """Confidence from which a detection counts. Default: the operating threshold of
    each detector (see `mi-splat detectors`).
    """
    inside: tuple[Annotated[str, Metavar("REGION")], ...] = ()
    """Directions from which the object is to be hidden, as --hide-from of `mi-splat
    poison` takes them: elevation:LOW-HIGH, azimuth:LOW-HIGH or
    cone:AZIMUTH,ELEVATION,HALF_ANGLE, in degrees around the centre of the object. The
    rates of missing the object inside and of detecting it outside are then reported,
    for the views in which the clean object is detected. Training cameras of a set in
    --cameras are counted separately.
    """
    conditions: tuple[Annotated[str, Metavar("CONDITION")], ...] = ()
    """Further conditions under which both are evaluated, to measure the robustness of
    the attack: "JPEG 75", "0.5 x size", "5 degrees", ".splat", "SH of degree 0", ray,
    "median of 8 neighbours" and others (see docs/defences.md), or standard for the
    usual ones.
    """
    cross_check: Detectors = ()
    """Further detectors that check the others: a view is flagged where one reports a
    class that the checking detector knows and does not report, or the other way round.
    `rapidocr`
    reads the word on stop signs.
    """
    images: Count = 8
    """Number of views shown side by side; 0 writes no images."""
    out: OutFolder = Path("out/evaluate")


def run(options: EvaluateOptions) -> None:
    """Evaluate, and write images and numbers."""
    from attacks.cli.options import box_finder, check_detectors
    from attacks.cli.summary import show_summary
    from attacks.figures.frame import write_figures
    from attacks.observe.comparison import (
        changed_mask,
        compared_cells,
        compared_rows,
        doubts,
        figures,
        side_by_side,
        thresholds_of,
    )
    from attacks.observe.conditions import check_condition
    from attacks.observe.rows import ATTACKED, CLEAN, ROWS
    from attacks.observe.sector import sector_doubts
    from attacks.observe.survival import named_conditions, together
    from attacks.observe.views import detect_scenes
    from mi_splat.cli.cameras import choose, look_at_object
    from mi_splat.io.documents import save_json, save_png
    from mi_splat.io.folders import RECORD, check_new_folder, new_folder
    from mi_splat.render.scene_files import open_scene

    check_no_input_in(options.out, options.clean, options.attacked)
    check_new_folder(options.out, force=options.force)
    check_detectors((*options.detectors, *options.cross_check))
    conditions = named_conditions(options.conditions)
    for name in conditions:
        check_condition(name, None)
    with progress("loading") as advance:
        clean = open_scene(options.clean)
        attacked = open_scene(options.attacked)
        if options.selection.is_empty:
            chosen = look_at_object(
                clean, changed_mask(clean.scene, attacked.scene), options.view
            )
        else:
            find_boxes = box_finder(options.detectors, options.weights)
            chosen = choose(
                clean, options.selection, options.view, find_boxes=find_boxes
            )
        detectors, checkers = _detectors(options)
        scenes = {CLEAN: clean.scene, ATTACKED: attacked.scene}
        names = list(chosen.cameras)
        cameras = list(chosen.cameras.values())
        confidence: float | dict[str, float] = thresholds_of(detectors)
        if options.min_confidence is not None:
            confidence = options.min_confidence
        place = _placing(options, clean.scene, chosen)
        advance(f"looking from {len(cameras)} cameras")
        seen = detect_scenes(
            scenes, chosen.mask, cameras, detectors, render=chosen.render
        )
        looked = compared_rows(
            seen,
            original=options.original or None,
            target=options.target,
            min_confidence=confidence,
            checkers=checkers,
            place=place,
        )
        if conditions:
            # What a detector calls the object here, it is under every condition.
            own = dict(looked.rows.select("detector", "original").iter_rows())
            given = dict.fromkeys(options.detectors, options.original or None)
            originals = {name: given.get(name) or own[name] for name in own}
            new_cells = partial(
                compared_cells,
                originals,
                target=options.target,
                checkers=checkers,
                place=place,
            )
            under = _under_conditions(conditions, scenes, chosen, detectors, new_cells)
            looked = together(looked, list(_announced(under, advance)))
        document = _document(options, chosen, scenes, detectors)
        document["warnings"] += chosen.doubts({}, chosen.agreement(clean))
        document["min_confidence"] = confidence
        if checkers:
            document["cross_checks"] = checkers
        counted = figures(document, {ROWS: looked.rows})
        document["warnings"] += doubts(looked.rows, counted, len(cameras))
        if options.inside:
            document["warnings"] += sector_doubts(counted, options.detectors)
        with new_folder(options.out, force=options.force) as folder:
            for detector in detectors if options.images else ():
                name = detector.name
                most = options.images
                drawn = side_by_side(
                    seen[CLEAN], seen[ATTACKED], detector=name, most=most, names=names
                )
                save_png(drawn, folder / f"{name}.png")
            save_json(document, folder / RECORD)
            looked.write(folder)
            write_figures(counted, folder)
    pairs = counted.having("checked_by").groups("detector", "checked_by").values()
    flagged = [pair for pair in pairs if pair.pooled("contradicted").successes]
    tables = len(flagged) + bool(options.inside) + bool(options.conditions)
    show_summary(options.out, as_json=options.json, tables=tables)


def _under_conditions(
    names: Sequence[str],
    scenes: Mapping[str, GaussianScene],
    chosen: Chosen,
    detectors: Sequence[Detector],
    new_cells: Callable[[], Callable[[ViewDetections], Mapping[str, Cell]]],
) -> Iterator[tuple[str, Observations]]:
    """Each condition, and what was seen under it."""
    from attacks.observe.conditions import Viewing
    from attacks.observe.rows import CLEAN
    from attacks.observe.survival import survived
    from mi_splat.cameras.framing import bounds

    centre, _ = bounds(scenes[CLEAN].select(chosen.mask))
    viewing = Viewing(
        settings=chosen.render.settings,
        centre=centre,
        alone=lambda scene: scene.select(chosen.mask),
    )
    cameras = list(chosen.cameras.values())
    return survived(
        scenes,
        chosen.mask,
        cameras,
        detectors,
        names,
        viewing=viewing,
        render=chosen.render,
        new_cells=new_cells,
    )


def _announced(
    parts: Iterable[tuple[str, Observations]], advance: Advance
) -> Iterator[Observations]:
    for name, part in parts:
        advance(f"looked under {name}")
        yield part


def _placing(
    options: EvaluateOptions, clean: GaussianScene, chosen: Chosen
) -> Callable[[ViewDetections], Mapping[str, Cell]] | None:
    """Says of a view where its camera stands by the sector; None without one."""
    if not options.inside:
        return None
    from attacks.cloak.triggers import trigger_of
    from attacks.observe.sector import sector_cells
    from mi_splat.cameras.framing import bounds
    from mi_splat.datasets import is_dataset, load_dataset

    trigger = trigger_of(options.inside, what="--inside")
    centre, _ = bounds(clean.select(chosen.mask))
    training: list[Camera] = []
    for text in options.view.cameras:
        if Path(text).is_dir() and is_dataset(text):
            training += load_dataset(text, split="train").cameras
    return sector_cells(
        lambda camera: trigger.angle_to_edge(camera, centre=centre),
        centre=centre,
        up=chosen.up,
        training=training,
    )


def _detectors(options: EvaluateOptions) -> tuple[list[Detector], dict[str, list[str]]]:
    """All detectors, and the classes of those that check the others."""
    from attacks.cli.options import check_class, load_detectors

    detectors = load_detectors(options.detectors, options.weights)
    for detector in detectors:
        check_class(
            options.original, detector.name, detector.classes, what="--original"
        )
        check_class(
            options.target or (), detector.name, detector.classes, what="--target"
        )
    checking = load_detectors(options.cross_check) if options.cross_check else []
    return [*detectors, *checking], {
        checker.name: list(checker.classes) for checker in checking
    }


def _document(
    options: EvaluateOptions,
    chosen: Chosen,
    scenes: Mapping[str, GaussianScene],
    detectors: Sequence[Detector],
) -> dict[str, Any]:
    """What result.json says."""
    from mi_splat.cameras.directions import UP
    from mi_splat.io.camera_records import describe
    from mi_splat.scene import scene_hash

    cameras = list(chosen.cameras.values())
    return {
        "story": "evaluate",
        "clean": str(options.clean),
        "attacked": str(options.attacked),
        "selection": options.selection.as_dict() or "the Gaussians that differ",
        "object_gaussians": int(chosen.mask.sum()),
        "original": list(options.original) or None,
        **({"inside": list(options.inside)} if options.inside else {}),
        **({} if chosen.up == UP else {"up": list(chosen.up)}),
        "cameras": [describe(name, camera) for name, camera in chosen.cameras.items()],
        **{f"{name}_hash": scene_hash(scene) for name, scene in scenes.items()},
        "fingerprints": {detector.name: detector.fingerprint for detector in detectors},
        "warnings": list(_doubts(cameras, options.attacked)),
        **provenance.rendered_with(chosen.render),
        **provenance.origin(),
    }


def _doubts(cameras: Sequence[Camera], attacked: Path) -> Iterator[str]:
    import torch

    from mi_splat.io.camera_records import recorded_cameras
    from mi_splat.io.folders import RECORD

    recorded = recorded_cameras(attacked.parent / RECORD, reference=False) or {}
    poses = [camera.to_world for camera in recorded.values()]
    same = sum(
        any(torch.allclose(camera.to_world, pose) for pose in poses)
        for camera in cameras
    )
    if same:
        yield (
            f"{same} of {len(cameras)} cameras are those that were attacked: pass"
            " others, with --cameras"
        )
