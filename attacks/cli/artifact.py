"""`mi-splat artifact`: a finished result as a folder that others can check."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from attacks.cli.options import check_result_folder
from mi_splat.cli.console import progress, show_result
from mi_splat.cli.flags import Positional
from mi_splat.cli.options import ResultOptions
from mi_splat.fields import Folder, Metavar

EXAMPLES = (
    "artifact out/cloak --out out/artifact",
    "artifact out/layers --whole --out out/layers-artifact",
)


@dataclass(frozen=True, kw_only=True)
class ArtifactOptions(ResultOptions):
    """Copy a finished result into a folder that others can check: its record, raw rows, cameras, and manifest.

    Splats and pictures are left out unless --whole is given. Nothing is packed whose files were changed, or whose rows
    do not give its figures. The manifest is copied as it is, so that the copy has the same name: the SHA-256 of it.
    """

    result: Positional[Annotated[Path, Metavar("RESULT")]]
    """Folder of the finished result."""
    out: Folder = Path("out/artifact")
    whole: bool = False
    """Copy splats and pictures, too, so that others can score the splats again."""


def check_inputs(options: ArtifactOptions) -> None:
    """Raise unless the folder may be a result."""
    check_result_folder(options.result)


def run(options: ArtifactOptions) -> None:
    """Copy the result, and say what the copy holds."""
    from attacks.report.checking import check_figures, pack, read_result
    from attacks.report.results import kind_of
    from mi_splat.io.folders import check_new_folder

    check_new_folder(options.out, force=options.force)
    with progress("packing", total=None):
        figures = kind_of(read_result(options.result)).figures
        result = pack(options.result, options.out, figures, whole=options.whole, force=options.force)
    rows = sum(map(len, result.tables.values()))
    count = sum(check.passed is True for check in check_figures(result, figures))
    document = {"out": str(options.out), "story": result.story, "manifest": result.manifest.sha256}
    size = sum(path.stat().st_size for path in options.out.rglob("*") if path.is_file())
    show_result(
        {**document, "rows": rows, "figures": count},
        f"{options.out}: {rows:,} rows, {count} figures that follow from them, {size / 1e3:,.0f} kB.",
        "Others check it, and that it is this one, with",
        f"mi-splat artifact-check {options.out} --manifest {result.manifest.sha256}",
        as_json=options.json,
    )
