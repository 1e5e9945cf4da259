"""`mi-splat evaluate-detector`: mAP and false positives of a small detector on held-out pictures."""

from __future__ import annotations

from pathlib import Path

import torch

from attacks.cli.training_options import EvaluateDetectorOptions
from attacks.detectors.base import Detector
from attacks.detectors.training.config import PictureSetConfig
from attacks.detectors.training.evaluate import (
    HeldOutResult,
    evaluate_sets,
    figures,
    held_out_sets,
    load_for_evaluation,
)
from attacks.detectors.training.pictures import LabelledPicture
from attacks.evaluation.visibility import visible_box, visible_weight
from attacks.gaussian_subset import GaussianSubset
from mi_splat.cli.console import progress, show, show_json, show_table
from mi_splat.io.documents import save_json
from mi_splat.io.folders import check_writable
from mi_splat.io.images import to_bytes
from mi_splat.rendering import Renderer
from mi_splat.scene_files import open_scene


def run(options: EvaluateDetectorOptions) -> int:
    """Make what is missing, score every set, print a table and write the figures."""
    check_writable(options.out.parent)
    torch.set_num_threads(options.threads)
    with progress("loading the detector") as advance:
        detector = load_for_evaluation(options.detector, options.weights)
        sets = held_out_sets(
            options.data,
            PictureSetConfig(split="held-out", count=options.pictures, samples=options.samples),
            splats=options.splats,
            splat=options.splat,
            backgrounds=options.backgrounds,
            processes=options.processes,
            on_work=lambda text, done, total: advance(f"{text}, {done:,} of {total:,}"),
        )
        for path in options.scenes:
            sets[str(path)] = scene_pictures(path, detector)
        advance("detecting")
        results = evaluate_sets(detector, sets)
    found = {"detector": detector.name, "fingerprint": detector.fingerprint, "sets": figures(results)}
    options.out.parent.mkdir(parents=True, exist_ok=True)
    save_json(found, options.out)
    if options.json:
        show_json(found)
    else:
        for name, result in results.items():
            _tell(name, result)
        show(f"{options.out}: every figure")
    return 0


def scene_pictures(path: Path, detector: Detector) -> list[LabelledPicture]:
    """A splat scene from each of its cameras at 8 bits; its shapes whose id is a class are its objects.

    Args:
        path: Scene XML.
        detector: Says which classes there are, and so what the labels count in.
    """
    loaded = open_scene(path)
    render, pictures = Renderer(loaded.settings), []
    for camera in loaded.cameras.values():
        with torch.no_grad():
            image = torch.from_numpy(to_bytes(render(loaded.scene, camera)))
        boxes, labels = [torch.zeros(0, 4)], []
        for number, name in enumerate(detector.classes, start=1):
            if name in loaded.objects:
                subset = GaussianSubset.of(loaded.scene, loaded.objects[name])
                box = visible_box(visible_weight(subset, camera, render))
                if box is not None:
                    boxes.append(box[None])
                    labels.append(number)
        pictures.append(LabelledPicture(image, torch.cat(boxes), torch.tensor(labels, dtype=torch.int64)))
    return pictures


def _tell(name: str, result: HeldOutResult) -> None:
    """One set: its false positives, and average precision by class where there are objects."""
    found = result.false_positives
    low, high = found.interval
    classes = ", ".join(f"{label} {count}" for label, count in found.by_class.items() if count)
    show(f"{name}: {found.pictures} pictures")
    show(
        f"  false positives per picture: {found.total} / {found.pictures} = {found.rate:.2f} ({low:.2f} to {high:.2f})"
        f", in {found.pictures_with} pictures{': ' + classes if classes else ''}"
    )
    if result.score is not None:
        score = result.score
        rows = [(f"  AP {label}", f"{ap:.3f} of {score.counts[label]}") for label, ap in score.ap.items()]
        show_table([*rows, ("  mAP", f"{score.mean:.3f}")])
