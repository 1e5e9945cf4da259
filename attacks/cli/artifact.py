"""`mi-splat artifact`: a finished result as a folder that others can check."""

from __future__ import annotations

from attacks.artifacts.contents import RECORD, read_object
from attacks.artifacts.packed import rows_of
from attacks.artifacts.packing import pack_artifact
from attacks.cli.artifact_options import ArtifactOptions
from mi_splat.cli.console import progress, show, show_json
from mi_splat.io.folders import check_new_folder


def run(options: ArtifactOptions) -> int:
    """Pack the result, and say what the artifact holds."""
    check_new_folder(options.out, force=options.force, record=RECORD)
    with progress("packing"):
        contents = pack_artifact(
            options.result,
            options.out,
            stages=options.stages,
            pages=options.page,
            splats=options.splats,
            force=options.force,
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
