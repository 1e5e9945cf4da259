"""What a study leaves behind: splats, pictures, tables and one summary."""

from __future__ import annotations

import shutil
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from attacks.cloak.study.config import StudyConfig
from attacks.cloak.study.markdown import markdown
from attacks.cloak.study.observations import ObservedSplat
from attacks.cloak.study.pipeline import MANIFEST, PictureSet, StudyPipeline
from attacks.cloak.study.plots import write_figures
from attacks.cloak.study.rates import figures
from attacks.cloak.study.rows import StudyRows
from attacks.cloak.study.snapshots import snapshot
from attacks.cloak.study.trained_splats import TrainedSplat
from attacks.detectors.base import Detector
from mi_splat import provenance
from mi_splat.io.atomic import sweep_temporary
from mi_splat.io.documents import save_json, save_text

STUDY, SUMMARY, TABLE = "study.json", "summary.json", "table.md"


def begin_report(study: StudyConfig, folder: Path) -> None:
    """Make the folder of the results and say in study.json whose they are."""
    folder.mkdir(parents=True, exist_ok=True)
    sweep_temporary(folder)
    save_json(snapshot(study), folder / STUDY)


def write_report(
    pipeline: StudyPipeline,
    poisoned: Mapping[int, PictureSet],
    observed: Sequence[ObservedSplat],
    detectors: Sequence[Detector],
    folder: Path,
) -> dict[str, Any]:
    """Write clean.ply and cloaked.ply of the first seed, the pictures, table.md, and summary.json last.

    Args:
        pipeline: The study.
        poisoned: Set of each seed, whose manifest says what was changed.
        observed: Every splat.
        detectors: Those that observed them.
        folder: For the results; see `begin_report`.

    Returns:
        The summary.

    Raises:
        SplatFileError: The folder cannot be written.
    """
    study, first, seen = pipeline.study, pipeline.study.seeds[0], StudyRows.of(observed)
    splats = [item.trained for item in observed if item.trained.seed == first]
    for splat in splats:
        shutil.copyfile(splat.file, folder / f"{splat.splat}.ply")
    shutil.copyfile(poisoned[first].folder / MANIFEST, folder / MANIFEST)
    pictures = write_figures(pipeline, seen, splats, detectors, folder)
    summary = {
        **figures(study, seen),
        "files": [*(f"{splat.splat}.ply" for splat in splats), MANIFEST, *pictures, TABLE],
        "splats": [_listed(item.trained) for item in observed],
        "detectors": {detector.name: detector.fingerprint for detector in detectors},
        "seeds": list(study.seeds),
        "study": snapshot(study),
        **provenance.origin(),
        "seconds": round(time.monotonic() - pipeline.begun, 1),
    }
    save_text(markdown(summary), folder / TABLE)
    save_json(summary, folder / SUMMARY)
    return summary


def _listed(trained: TrainedSplat) -> dict[str, Any]:
    """A trained splat as JSON can hold it; its file apart, which is a matter of this machine."""
    values = asdict(trained)
    del values["file"]
    return values
