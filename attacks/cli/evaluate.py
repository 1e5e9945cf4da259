"""`mi-splat evaluate`: a clean and an attacked splat from many cameras, and what detectors make of both."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from attacks.cli.names import check_class
from attacks.cli.options import ClassName, Confidence, Detectors
from mi_splat import provenance
from mi_splat.cli.console import progress, show, show_json, show_table, warn
from mi_splat.cli.flags import Positional, Unprefixed
from mi_splat.cli.options import CameraOptions
from mi_splat.fields import Count, Folder
from mi_splat.selection.config import Selection

if TYPE_CHECKING:
    from attacks.observe.comparison import Comparison
    from attacks.observe.views import ViewDetections
    from attacks.rate import Rate
    from mi_splat.cameras import Camera
    from mi_splat.cli.cameras import Chosen


EXAMPLES = ("evaluate desk.ply out/desk/attacked.ply --cameras hemisphere:24 --target person --out out/judged",)
SEE_ALSO = ("dagger", "detect")


@dataclass(frozen=True, slots=True, kw_only=True)
class EvaluateOptions:
    """Look at a clean and an attacked splat from many cameras, and compare what detectors make of them.

    Says how often the object is found, missed, or taken for the target, with 95 % intervals. The cameras should be
    others than those that were attacked. Writes a picture of both splats side by side for each detector,
    the rows and result.json into --out.
    """

    clean: Positional[Path]
    """The splat or scene XML before the attack."""
    attacked: Positional[Path]
    """The splat or scene XML after it."""
    selection: Unprefixed[Selection] = field(default_factory=Selection)
    """The object in the clean splat; if nothing is said, the Gaussians that differ."""
    view: Unprefixed[CameraOptions] = field(default_factory=CameraOptions)
    """Where both are looked at from."""
    detectors: Detectors = ("fasterrcnn_small",)
    """Names of detectors (see `mi-splat detectors`)."""
    weights: tuple[Path, ...] = ()
    """Files with their weights, as many as there are detectors; none takes the shipped or published ones."""
    original: ClassName | None = None
    """Class that the object is; None is what each detector calls it in most views of the clean splat."""
    target: ClassName | None = None
    """Class that the attacker wants."""
    min_confidence: Confidence = 0.5
    """Confidence from which a detection counts."""
    pictures: Count = 8
    """Views shown side by side; 0 writes no pictures."""
    out: Folder = Path("out/evaluate")
    """Folder for the results; a new one."""
    force: bool = False
    """Replace a folder that an earlier call has written."""
    json: bool = False
    """Print the figures as one JSON document on stdout."""


ATTACKED = "attacked"
WORDS = {
    "found_clean": "found in the clean splat",
    "found_attacked": "found in the attacked one",
    "missed": "missed, of those found",
    "target_clean": "taken for the target, clean",
    "target_attacked": "taken for the target, attacked",
}


def run(options: EvaluateOptions) -> int:
    """Evaluate, and write pictures and numbers."""
    from attacks.cli.names import load_detectors
    from attacks.observe.comparison import changed_mask, compare, compared_rows
    from attacks.observe.views import CLEAN, evaluate
    from mi_splat.cli.cameras import choose, look_at_object
    from mi_splat.io.documents import save_json
    from mi_splat.io.folders import RECORD, check_new_folder, new_folder
    from mi_splat.scene import scene_hash
    from mi_splat.scene_files import open_scene
    from mi_splat.selection.select import doubts

    check_new_folder(options.out, force=options.force)
    with progress("loading") as advance:
        clean, attacked = open_scene(options.clean), open_scene(options.attacked)
        if options.selection.is_empty:
            chosen = look_at_object(clean, changed_mask(clean.scene, attacked.scene), options.view)
        else:
            chosen = choose(clean, options.selection, options.view)
        detectors = load_detectors(options.detectors, options.weights)
        for detector in detectors:
            check_class(options.original, detector.name, detector.classes, what="--original")
            check_class(options.target, detector.name, detector.classes, what="--target")
        scenes = {CLEAN: clean.scene, ATTACKED: attacked.scene}
        cameras = list(chosen.cameras.values())
        advance(f"looking from {len(cameras)} cameras")
        seen = evaluate(scenes, chosen.mask, cameras, detectors, render=chosen.render)
        looked = compared_rows(
            seen, original=options.original, target=options.target, min_confidence=options.min_confidence
        )
        comparisons = compare(looked.rows, confidence=options.min_confidence)
        reasons = [*doubts(chosen.mask, {}), *_doubts(comparisons, chosen.cameras, options.attacked)]
        document = {
            "story": "evaluate",
            **_asked(options, chosen),
            **{f"{name}_hash": scene_hash(scene) for name, scene in scenes.items()},
            "fingerprints": {detector.name: detector.fingerprint for detector in detectors},
            "detectors": {comparison.detector: comparison.as_dict() for comparison in comparisons},
            "warnings": reasons,
            **provenance.rendered_with(chosen.render),
            **provenance.origin(),
        }
        with new_folder(options.out, force=options.force) as folder:
            _save_pictures(seen, list(chosen.cameras), list(document["detectors"]), options.pictures, folder)
            save_json(document, folder / RECORD)
            looked.write(folder)
    if options.json:
        show_json({**document, "out": str(options.out)})
    else:
        _tell(comparisons, reasons, options)
    return 0


def _asked(options: EvaluateOptions, chosen: Chosen) -> dict[str, Any]:
    """What was evaluated, from where, and by which rule; a part of the record."""
    from mi_splat.io.camera_records import describe

    return {
        "clean": str(options.clean),
        "attacked": str(options.attacked),
        "selection": options.selection.as_dict() or "the Gaussians that differ",
        "object_gaussians": int(chosen.mask.sum()),
        "original": options.original,
        "min_confidence": options.min_confidence,
        "cameras": [describe(name, camera) for name, camera in chosen.cameras.items()],
    }


def _save_pictures(
    seen: Mapping[str, Sequence[ViewDetections]], names: list[str], detectors: Iterable[str], most: int, folder: Path
) -> None:
    """Both splats side by side with boxes, a picture for each detector; none where `most` is 0."""
    from attacks.observe.comparison import side_by_side
    from attacks.observe.views import CLEAN
    from mi_splat.io.documents import save_png

    for detector in detectors if most else ():
        drawn = side_by_side(seen[CLEAN], seen[ATTACKED], detector=detector, most=most, names=names)
        save_png(drawn, folder / f"{detector}.png")


def _doubts(comparisons: list[Comparison], cameras: Mapping[str, Camera], attacked: Path) -> list[str]:
    """Reasons to look twice before the rates are believed."""
    import torch

    from mi_splat.io.camera_records import recorded_cameras
    from mi_splat.io.folders import RECORD

    recorded = recorded_cameras(attacked.parent / RECORD, reference=False) or {}
    poses = [camera.to_world for camera in recorded.values()]
    same = sum(any(torch.allclose(camera.to_world, pose) for pose in poses) for camera in cameras.values())
    text = f"{same} of {len(cameras)} cameras are those that were attacked: pass others, with --cameras"
    doubts = [doubt for comparison in comparisons for doubt in comparison.doubts(len(cameras))]
    return [text, *doubts] if same else doubts


def _tell(comparisons: list[Comparison], reasons: list[str], options: EvaluateOptions) -> None:
    """A table for each detector, and where to look."""
    from mi_splat.io.folders import RECORD

    for comparison in comparisons:
        target = "" if comparison.target is None else f", target {comparison.target}"
        show(f"{comparison.detector}: {comparison.original or 'any object'}{target}, {comparison.views} views")
        rows = [(f"  {WORDS[name]}", _counted(rate)) for name, rate in comparison.rates.items()]
        change = "the same" if comparison.psnr is None else f"{comparison.psnr:.1f} dB"
        show_table([*rows, ("  pictures, attacked against clean", change)])
    for reason in reasons:
        warn(f"warning: {reason}")
    show(f"{options.out}: pictures side by side, and {RECORD}")


def _counted(rate: Rate) -> str:
    low, high = rate.interval
    return f"{rate.successes} of {rate.total} (95 % interval {low:.0%} to {high:.0%})"
