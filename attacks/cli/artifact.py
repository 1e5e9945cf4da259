"""`mi-splat artifact`: a finished result as a folder that others can check."""

from __future__ import annotations

from attacks.cli.artifact_options import ArtifactOptions
from attacks.report.checking import check_figures, read_result
from attacks.report.packing import pack
from attacks.report.results import story_of
from mi_splat.cli.console import progress, show, show_json
from mi_splat.io.folders import RECORD, check_new_folder


def run(options: ArtifactOptions) -> int:
    """Copy the result, and say what the copy holds."""
    check_new_folder(options.out, force=options.force, record=RECORD)
    with progress("packing", total=None):
        figures = story_of(read_result(options.result)).figures
        result = pack(options.result, options.out, figures, whole=options.whole, force=options.force)
    rows = sum(map(len, result.tables.values()))
    checks = [one for one in check_figures(result, figures) if one.passed]
    told = {"out": str(options.out), "story": result.story, "manifest": result.manifest.sha256}
    if options.json:
        show_json({**told, "rows": rows, "figures": len(checks)})
        return 0
    size = sum(path.stat().st_size for path in options.out.rglob("*") if path.is_file())
    show(f"{options.out}: {rows:,} rows, {len(checks)} figures that follow from them, {size / 1e3:,.0f} kB.")
    show("Others check it, and that it is this one, with")
    show(f"mi-splat artifact-check {options.out} --manifest {result.manifest.sha256}")
    return 0
