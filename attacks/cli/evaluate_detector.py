"""`mi-splat evaluate-detector`: mAP, recall and false positives of detectors on held-out pictures."""

from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from attacks.cli.options import Confidence, DetectorOptions, Processes, Threads
from attacks.detectors.training.config import BackgroundConfig, PictureSetConfig, SplatConfig
from mi_splat import provenance
from mi_splat.cli.console import follow, progress, show_result
from mi_splat.cli.options import ResultOptions, Samples
from mi_splat.fields import Count, Folder

EXAMPLES = (
    "evaluate-detector --weights out/detector/best.safetensors",
    "evaluate-detector --detectors fasterrcnn_small yolov8n_small --out out/compared",
)
SEE_ALSO = ("train-detector", "detectors")


@dataclass(frozen=True, kw_only=True)
class EvaluateDetectorOptions(DetectorOptions, ResultOptions):
    """Score detectors on objects, cameras, lights and surroundings that the project's own were not trained on.

    Average precision by class; recall by elevation, distance, size, brightness and sun; and false positives per
    picture: of pictures with objects, and of streets, parks, rooms, grounds and random surroundings without any. A
    detector of other classes, for instance one trained on COCO, is scored on those of the project's eight that it
    knows; what else it reports is listed. Several detectors are put side by side. Writes result.json and the rows into
    --out.
    """

    data: Folder = Path("out/detector-data")
    """Folder of the pictures; what is missing in it is made first."""
    out: Folder = Path("out/detectors")
    """Folder for the results: a new one, written whole at the end."""
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


def run(options: EvaluateDetectorOptions) -> int:
    """Make what is missing, let every detector look, write rows and figures, and print them as tables."""
    from attacks.report.stories.detectors.held_out import documents, tables
    from mi_splat.io.folders import check_new_folder

    check_new_folder(options.out, force=options.force)
    record = _evaluated(options)
    lines = (table.markdown + "\n" for table in tables(documents(record)))
    show_result(record, *lines, f"{options.out}: every figure and the rows", as_json=options.json)
    return 0


def _evaluated(options: EvaluateDetectorOptions) -> dict[str, Any]:
    """Look, write the result, and return its record."""
    import polars as pl
    import torch

    from attacks.cli.names import weights_of
    from attacks.detectors.evaluation import figures, lacking, load_for_evaluation, look_at, splat_scene_pictures
    from attacks.detectors.training.dataset import held_out_sets, made
    from attacks.observe.look import Looked
    from attacks.observe.rows import DETECTIONS, ROWS
    from mi_splat.io.documents import save_json
    from mi_splat.io.folders import RECORD, new_folder

    torch.set_num_threads(options.threads)
    pictures = PictureSetConfig(split="held-out", count=options.pictures, samples=options.samples)
    with progress("loading the detectors") as advance:
        files = weights_of(options.detectors, options.weights)
        detectors = [load_for_evaluation(name, files.get(name)) for name in options.detectors]
        jobs = held_out_sets(pictures, splats=options.splats, splat=options.splat, backgrounds=options.backgrounds)
        sets = made(options.data, jobs, processes=options.processes, on_work=follow(advance))
        sets |= {str(path): splat_scene_pictures(path) for path in options.scenes}
        advance("detecting")
        looks = [look_at(detector, sets) for detector in detectors]
    seen = Looked(rows=pl.concat(look.rows for look in looks), detections=pl.concat(look.detections for look in looks))
    record: dict[str, Any] = {
        "story": "evaluate-detector",
        "confidence": options.confidence,
        "sets": {name: len(members) for name, members in sets.items()},
        "detectors": {
            detector.name: {
                "fingerprint": detector.fingerprint,
                "min_confidence": detector.min_confidence,
                **({"lacks": list(lacking(detector))} if lacking(detector) else {}),
            }
            for detector in detectors
        },
    }
    counted = figures(record, {ROWS: seen.rows, DETECTIONS: seen.detections})["detectors"]
    record |= {
        "detectors": {name: {**values, **counted[name]} for name, values in record["detectors"].items()},
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
    with new_folder(options.out, force=options.force) as folder:
        save_json(record, folder / RECORD)
        seen.write(folder)
    return record
