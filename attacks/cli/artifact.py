"""`mi-splat artifact` and `artifact-check`: a finished result as a folder that others
can check, and the check.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from attacks.cli.options import check_result_folder
from mi_splat.cli.console import UsageError, progress, show, show_json, show_result
from mi_splat.cli.flags import Positional
from mi_splat.cli.options import JsonOptions, ResultOptions
from mi_splat.errors import MiSplatError
from mi_splat.fields import Folder, Metavar, OutFolder

if TYPE_CHECKING:
    from attacks.report.checking import Check

EXAMPLES = (
    "artifact out/cloak --out out/artifact",
    "artifact out/layers --whole --out out/layers-artifact",
    "artifact-check out/artifact",
)


@dataclass(frozen=True, kw_only=True)
class ArtifactOptions(ResultOptions):
    """Copy a finished result into a folder that others can check: its record, raw rows,
    cameras, and manifest.

    Splats and images are left out unless --whole is given. A result is refused if its
    files were changed, or if its rows do not reproduce its figures. The manifest is
    copied as it is, so that the copy has the same name: the SHA-256 of it.
    """

    result: Positional[Annotated[Path, Metavar("RESULT")]]
    """Folder of the finished result."""
    out: OutFolder = Path("out/artifact")
    whole: bool = False
    """Also copy splats and images, so that others can evaluate the splats again."""


def check_inputs(options: ArtifactOptions) -> None:
    """Raise unless the folder may be a result."""
    check_result_folder(options.result)


def run(options: ArtifactOptions) -> None:
    """Copy the result, and say what the copy holds."""
    from attacks.figures.result import read_result
    from attacks.report.checking import pack
    from attacks.report.results import kind_of
    from mi_splat.io.folders import check_new_folder

    check_new_folder(options.out, force=options.force)
    with progress("packing", total=None):
        derive = kind_of(read_result(options.result)).derive
        result = pack(
            options.result,
            options.out,
            derive,
            whole=options.whole,
            force=options.force,
        )
    rows = sum(map(len, result.tables.values()))
    count = 0 if derive is None else len(result.figures)
    document = {
        "out": str(options.out),
        "story": result.kind,
        "manifest": result.manifest.sha256,
    }
    size = sum(path.stat().st_size for path in options.out.rglob("*") if path.is_file())
    show_result(
        {**document, "rows": rows, "figures": count},
        f"{options.out}: {rows:,} rows, {count} figures that follow from them,"
        f" {size / 1e3:,.0f} kB.",
        "Others check it, and that it is this one, with",
        f"mi-splat artifact-check {options.out} --manifest {result.manifest.sha256}",
        as_json=options.json,
    )


@dataclass(frozen=True, kw_only=True)
class ArtifactCheckOptions(JsonOptions):
    """Check results: the bytes of every file, and every figure, derived again from the
    raw rows alone.

    Each file and each figure is a line, green, red, or grey where it was left out. The
    exit status is 1 if one is red.
    """

    folders: Positional[tuple[Folder, ...]] = ()
    """Folders of results or of their copies; at least one."""
    manifest: Annotated[tuple[str, ...], Metavar("SHA256")] = ()
    """Expected SHA-256 of each folder's manifest. Default: not checked."""


def run_check(options: ArtifactCheckOptions) -> int:
    """Check each artifact against the manifest."""
    if not options.folders:
        raise UsageError.of("folders", "folders of results", "none", "name one")
    if options.manifest and len(options.manifest) != len(options.folders):
        expected = f"one for each of the {len(options.folders)} folders"
        raise UsageError.of(
            "--manifest", expected, len(options.manifest), "name one for each"
        )
    checks: dict[str, list[Check]] = {}
    for number, folder in enumerate(options.folders):
        checks[str(folder)] = _checked(
            folder, options.manifest[number] if options.manifest else None
        )
        if not options.json:
            for line in checks[str(folder)]:
                show(f"{line.colour:5}  {line.name}: {line.words}")
            red = sum(line.passed is False for line in checks[str(folder)])
            show(f"{folder}: {red} of {len(checks[str(folder)])} lines are red.")
    if options.json:
        show_json(
            {
                folder: [line.as_dict() for line in lines]
                for folder, lines in checks.items()
            }
        )
    if any(line.passed is False for lines in checks.values() for line in lines):
        return 1
    return 0


def _checked(folder: Path, manifest: str | None) -> list[Check]:
    """Every line of one result; one that cannot be read is one red line, so that the
    others are still checked.
    """
    from attacks.figures.result import read_result
    from attacks.report.checking import Check, check_result
    from attacks.report.results import kind_of

    try:
        result = read_result(folder)
        return check_result(result, kind_of(result).derive, manifest=manifest)
    except MiSplatError as error:
        hint = f" ({error.hint})" if error.hint else ""
        return [
            Check(
                name=str(folder), words=" ".join(f"{error}{hint}".split()), passed=False
            )
        ]
