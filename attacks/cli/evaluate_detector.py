"""`mi-splat evaluate-detector`: mAP, recall and false positives of a detector on held-out pictures."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from attacks.cli.options import Confidence, OneDetector, Processes, Threads
from attacks.detectors.catalogue import SMALL_CLASSES
from attacks.detectors.training.config import BackgroundConfig, PictureSetConfig, SplatConfig
from mi_splat import provenance
from mi_splat.cli.console import progress, show_result
from mi_splat.cli.options import Samples
from mi_splat.errors import InvalidValueError, message
from mi_splat.fields import Count, Folder
from mi_splat.io.locks import locked_folder

if TYPE_CHECKING:
    from attacks.detectors.training.pictures import LabelledPicture


EXAMPLES = (
    "evaluate-detector --weights out/detector/best.safetensors",
    "evaluate-detector --detectors centernet_coco --out out/centernet.json",
)
SEE_ALSO = ("compare-detectors", "train-detector")


@dataclass(frozen=True, slots=True, kw_only=True)
class EvaluateDetectorOptions:
    """Score a detector on objects, cameras, lights and surroundings that the project's own were not trained on.

    Average precision by class; recall by elevation, distance, size, brightness and sun; and false positives per
    picture: of pictures with objects, and of streets, parks, rooms, grounds and random surroundings without any. A
    detector of more classes, for instance one trained on COCO, is scored on the project's eight; what else it reports
    is listed.
    """

    detector: OneDetector = "fasterrcnn_small"
    """Name of a detector that knows the eight classes (see `mi-splat detectors`)."""
    weights: Path | None = None
    """Weights to score; None takes the usual ones."""
    data: Folder = Path("out/detector-data")
    """Folder of the pictures; what is missing in it is made first."""
    out: Path = Path("out/detector/held-out.json")
    """JSON file for the figures; `mi-splat report` makes a page of it."""
    pictures: Count = 240
    """Path-traced pictures with objects."""
    samples: Samples = 24
    """Samples per pixel in them."""
    splats: Count = 32
    """Scenes that are made into splats; 0 leaves them out."""
    splat: SplatConfig = field(default_factory=SplatConfig)
    """How splats are made."""
    backgrounds: BackgroundConfig = field(default_factory=BackgroundConfig)
    """Pictures without any object."""
    confidence: Confidence = 0.5
    """Least confidence of an object that is found, and of a false positive."""
    scenes: tuple[Path, ...] = ()
    """Scene XMLs of splats to score as well, from all their cameras; shapes whose id is a class are their objects."""
    processes: Processes = 2
    """Processes that make pictures; 0 makes them in this one."""
    threads: Threads = 1
    """Threads of torch."""
    json: bool = False
    """Print the figures as one JSON document on stdout."""


def run(options: EvaluateDetectorOptions) -> int:
    """Make what is missing, score every set, write the figures and print them as tables."""
    from attacks.detectors.evaluation.tables import detector_tables
    from mi_splat.io.documents import save_json
    from mi_splat.io.folders import check_writable

    check_writable(options.out.parent)
    if options.out.suffix != ".json":
        do = f"for instance {options.out.with_suffix('.json')}"
        raise InvalidValueError(message("--out", "a file name that ends in .json", str(options.out), do))
    figures = _figures(options)
    options.out.parent.mkdir(parents=True, exist_ok=True)
    save_json(figures, options.out)
    show_result(figures, detector_tables(figures), f"{options.out}: every figure", as_json=options.json)
    return 0


def _figures(options: EvaluateDetectorOptions) -> dict[str, Any]:
    """Everything that is measured, and on what."""
    import torch

    from attacks.detectors.evaluation.held_out import (
        held_out_sets,
        load_for_evaluation,
        measure_sets,
        total_false_positives,
    )

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
        measured = measure_sets(detector, sets, confidence=options.confidence)
    return {
        "detector": detector.name,
        "fingerprint": detector.fingerprint,
        "min_confidence": detector.min_confidence,
        "confidence": options.confidence,
        "false_positives": total_false_positives(measured),
        "sets": {name: measurement.as_dict() for name, measurement in measured.items()},
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


def scene_pictures(path: Path) -> list[LabelledPicture]:
    """A splat scene XML from each of its cameras at 8 bits; shapes whose id is a class (or stop_sign) are objects."""
    import torch

    from attacks.detectors.training.pictures import LabelledPicture, viewing_conditions
    from attacks.gaussian_subset import GaussianSubset
    from attacks.observe.views import visible_box, visible_weight
    from mi_splat.io.images import to_bytes
    from mi_splat.rendering import Renderer
    from mi_splat.scene_files import open_scene

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
        numbers = torch.tensor(labels, dtype=torch.int64)
        pictures.append(LabelledPicture(image, torch.cat(boxes), numbers, tuple(conditions)))
    return pictures
