"""`mi-splat evaluate-detector`: mAP, recall and false positives of a detector on held-out pictures."""

from __future__ import annotations

import importlib.util
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch

from attacks.cli.training_options import EvaluateDetectorOptions
from attacks.detectors.classes import SMALL_CLASSES
from attacks.detectors.evaluation.held_out import (
    HeldOutResult,
    evaluate_sets,
    figures,
    held_out_sets,
    load_for_evaluation,
    total_false_positives,
)
from attacks.detectors.evaluation.plots import draw_recall
from attacks.detectors.evaluation.recall import recall_by
from attacks.detectors.evaluation.tables import detector_tables, rate
from attacks.detectors.training.conditions import viewing_conditions
from attacks.detectors.training.config import PictureSetConfig
from attacks.detectors.training.pictures import LabelledPicture
from attacks.gaussian_subset import GaussianSubset
from attacks.observe.views import visible_box, visible_weight
from mi_splat import provenance
from mi_splat.cli.console import progress, show, show_json, show_table
from mi_splat.errors import InvalidValueError, install, message
from mi_splat.io.atomic import atomic_write
from mi_splat.io.documents import save_json, save_text
from mi_splat.io.folders import check_writable
from mi_splat.io.images import to_bytes
from mi_splat.io.locks import locked_folder
from mi_splat.rendering import Renderer
from mi_splat.scene_files import open_scene


def run(options: EvaluateDetectorOptions) -> int:
    """Make what is missing, score every set, print a table and write the figures."""
    check_writable(options.out.parent)
    check_suffix("--out", options.out, ".json")
    torch.set_num_threads(options.threads)
    pictures = PictureSetConfig(split="held-out", count=options.pictures, samples=options.samples)
    with progress("loading the detector") as advance:
        detector = load_for_evaluation(options.detector, options.weights)
        with locked_folder(options.data):
            sets = held_out_sets(
                options.data,
                pictures,
                splats=options.splats,
                splat=options.splat,
                backgrounds=options.backgrounds,
                processes=options.processes,
                on_work=lambda text, done, total: advance(f"{text}, {done:,} of {total:,}"),
            )
        for path in options.scenes:
            sets[str(path)] = scene_pictures(path)
        advance("detecting")
        results = evaluate_sets(detector, sets, confidence=options.confidence)
    found = {
        "detector": detector.name,
        "fingerprint": detector.fingerprint,
        "min_confidence": detector.min_confidence,
        "confidence": options.confidence,
        "false_positives": total_false_positives(results),
        "sets": figures(results),
        "pictures": {
            "path_traced": asdict(pictures),
            "splats": options.splats,
            "splat": asdict(options.splat),
            "backgrounds": asdict(options.backgrounds),
        },
        "data": str(options.data),
        "scenes": list(map(str, options.scenes)),
        **provenance.origin(),
    }
    options.out.parent.mkdir(parents=True, exist_ok=True)
    save_json(found, options.out)
    written = write_tables(detector_tables(found), [found], options.out)
    if options.json:
        show_json(found)
    else:
        for name, result in results.items():
            _tell(name, result)
        show(f"{options.out}: every figure; {written}")
    return 0


def write_tables(text: str, several: Sequence[Mapping[str, Any]], path: Path) -> str:
    """Write tables beside a file, and recall as a picture where matplotlib is installed.

    Args:
        text: The tables in Markdown.
        several: What to draw, one document a detector.
        path: The ending is replaced by .md and .png.

    Returns:
        What was written, in words.
    """
    tables, picture = path.with_suffix(".md"), path.with_suffix(".png")
    save_text(text, tables)
    if importlib.util.find_spec("matplotlib") is None:
        return f"{tables}: tables (no picture: {install('figures')})"
    figure = draw_recall(several)
    with atomic_write(picture) as file:
        figure.savefig(file, format="png")
    return f"{tables}: tables; {picture}: recall"


def check_suffix(option: str, path: Path, suffix: str) -> None:
    """Raise unless a file ends as it has to, so that what is written beside it does not replace it."""
    if path.suffix != suffix:
        do = f"for instance {path.with_suffix(suffix)}"
        raise InvalidValueError(message(option, f"a file name that ends in {suffix}", str(path), do))


def scene_pictures(path: Path) -> list[LabelledPicture]:
    """A splat scene XML from each of its cameras at 8 bits; shapes whose id is a class (or stop_sign) are objects."""
    loaded = open_scene(path)
    render, pictures = Renderer(loaded.settings), []
    for camera in loaded.cameras.values():
        with torch.no_grad():
            image = torch.from_numpy(to_bytes(render(loaded.scene, camera)))
        boxes, labels, conditions = [torch.zeros(0, 4)], [], []
        for number, name in enumerate(SMALL_CLASSES, start=1):
            rows = loaded.objects.get(name, loaded.objects.get(name.replace(" ", "_")))
            if rows is not None:
                subset = GaussianSubset.of(loaded.scene, rows)
                box = visible_box(visible_weight(subset, camera, render))
                if box is not None:
                    boxes.append(box[None])
                    labels.append(number)
                    points = loaded.scene.means[rows].numpy()
                    conditions.append(viewing_conditions(points, camera))
        found = torch.tensor(labels, dtype=torch.int64)
        pictures.append(LabelledPicture(image, torch.cat(boxes), found, tuple(conditions)))
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
        bins = [
            (f"  recall at {one.low:g} to {one.high:g} degrees", rate(one.as_dict()))
            for one in recall_by(result.objects, "elevation")
            if one.rate.total
        ]
        show_table([*rows, ("  mAP", f"{score.mean:.3f}"), *bins])
    if result.other_classes:
        often = list(result.other_classes.items())[:8]
        show(f"  other classes reported: {', '.join(f'{label} {count}' for label, count in often)}")
