"""`mi-splat artifact-check`: every file and every figure of artifacts; red lines end with exit status 1."""

from __future__ import annotations

import os
from pathlib import Path

from attacks.artifacts.checking import Checked, check_artifact, check_pages
from attacks.artifacts.contents import RECORD
from attacks.artifacts.figures import Line
from attacks.artifacts.rescoring import rescore
from attacks.cli.artifact_options import ArtifactCheckOptions
from attacks.cli.loading import load_detectors
from mi_splat.cli.console import limit_threads, progress, show, show_json
from mi_splat.cli.ranges import UsageError
from mi_splat.errors import MiSplatError, message


def run(options: ArtifactCheckOptions) -> int:
    """Check each artifact; 1 if a line is red."""
    if not options.folders:
        raise UsageError(message("folders", "folders of artifacts", "none", "name one"))
    given = [
        flag
        for flag, is_given in (
            ("--splats", options.splats is not None),
            ("--detectors", bool(options.detectors)),
            ("--weights", bool(options.weights)),
            ("--every", options.every != 1),
        )
        if is_given
    ]
    if given and not options.rescore:
        raise UsageError(message(given[0], "--rescore beside it", "none", "add --rescore"))
    found: dict[str, list[Line]] = {}
    for folder in options.folders:
        found[str(folder)] = _lines(folder, options)
        if not options.json:
            _tell(folder, found[str(folder)])
    if options.json:
        show_json({folder: [line.as_dict() for line in lines] for folder, lines in found.items()})
    return 1 if any(line.passed is False for lines in found.values() for line in lines) else 0


def _lines(folder: Path, options: ArtifactCheckOptions) -> list[Line]:
    """Every line of one artifact; one that cannot be read is one red line, so that the others are still checked."""
    try:
        checked = check_artifact(folder)
        lines = [*checked.files, *checked.figures]
        if options.pages is not None:
            lines += check_pages(checked, options.pages)
        return lines + (_rescored(checked, options) if options.rescore else [])
    except MiSplatError as error:
        hint = f" ({error.hint})" if error.hint else ""
        return [Line(name=str(folder / RECORD), words=" ".join(f"{error}{hint}".split()), passed=False)]


def _rescored(checked: Checked, options: ArtifactCheckOptions) -> list[Line]:
    """What detectors say today."""
    limit_threads((os.cpu_count() or 1) // 2)
    with progress("loading the detectors", total=None) as advance:
        names = options.detectors or tuple(checked.contents.detectors)
        detectors = load_detectors(names, options.weights)
        return rescore(
            checked,
            detectors,
            splats=options.splats,
            every=options.every,
            rate_tolerance=options.rate_tolerance,
            on_view=lambda done, total: advance(f"looking again, {done:,} of {total:,}"),
        )


def _tell(folder: Path, lines: list[Line]) -> None:
    for line in lines:
        show(f"{line.colour:5}  {line.name}: {line.words}")
    red = sum(line.passed is False for line in lines)
    show(f"{folder}: {red} of {len(lines)} lines are red.")
