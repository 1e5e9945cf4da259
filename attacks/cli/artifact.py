"""`mi-splat artifact`: a finished result as a folder that others can check."""

from __future__ import annotations

import os

from attacks.artifacts.contents import RECORD, read_object
from attacks.artifacts.packed import rows_of
from attacks.artifacts.packing import pack_artifact
from attacks.artifacts.study_results import detectors_of
from attacks.cli.artifact_options import ArtifactOptions
from attacks.cli.loading import load_detectors
from mi_splat.cli.console import limit_threads, progress, show, show_json
from mi_splat.cli.ranges import UsageError
from mi_splat.errors import message
from mi_splat.io.folders import check_new_folder


def run(options: ArtifactOptions) -> int:
    """Pack the result, and say what the artifact holds."""
    check_new_folder(options.out, force=options.force, record=RECORD)
    if options.weights and not options.detections:
        raise UsageError(message("--weights", "--detections beside it", "none", "add --detections"))
    with progress("packing", total=None) as advance:
        detectors = []
        if options.detections:
            limit_threads((os.cpu_count() or 1) // 2)
            detectors = load_detectors(detectors_of(options.result), options.weights)
        contents = pack_artifact(
            options.result,
            options.out,
            stages=options.stages,
            pages=options.page,
            splats=options.splats,
            force=options.force,
            detectors=detectors,
            on_view=lambda done, total: advance(f"looking again, {done:,} of {total:,}"),
        )
    if options.json:
        show_json(read_object(options.out / RECORD))
        return 0
    size = sum(path.stat().st_size for path in options.out.rglob("*") if path.is_file())
    show(
        f"{options.out}: {contents.name} ({contents.kind}), {rows_of(contents.tables):,} rows, "
        f"{len(contents.figures)} figures that follow from them, {size / 1e3:,.0f} kB."
    )
    show(f"Others check it with mi-splat artifact-check {options.out}")
    return 0
