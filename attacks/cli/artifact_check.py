"""`mi-splat artifact-check`: every file and every figure of artifacts; red lines end with exit status 1."""

from __future__ import annotations

import os
from pathlib import Path

from attacks.cli.artifact_options import ArtifactCheckOptions
from attacks.cli.loading import load_detectors
from attacks.report.checking import Check, Result, check_detections, check_figures, check_files, read_result
from attacks.report.rescoring import fingerprints, rescore
from attacks.report.results import Story, story_of
from mi_splat.cli.console import UsageError, limit_threads, progress, show, show_json
from mi_splat.errors import MiSplatError, message


def run(options: ArtifactCheckOptions) -> int:
    """Check each artifact; 1 if a line is red."""
    if not options.folders:
        raise UsageError(message("folders", "folders of results", "none", "name one"))
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
    if options.manifest and len(options.manifest) != len(options.folders):
        expected = f"one for each of the {len(options.folders)} folders"
        raise UsageError(message("--manifest", expected, len(options.manifest), "name one for each"))
    found: dict[str, list[Check]] = {}
    for number, folder in enumerate(options.folders):
        found[str(folder)] = _lines(folder, options.manifest[number] if options.manifest else None, options)
        if not options.json:
            _tell(folder, found[str(folder)])
    if options.json:
        show_json({folder: [line.as_dict() for line in lines] for folder, lines in found.items()})
    return 1 if any(line.passed is False for lines in found.values() for line in lines) else 0


def _lines(folder: Path, manifest: str | None, options: ArtifactCheckOptions) -> list[Check]:
    """Every line of one result; one that cannot be read is one red line, so that the others are still checked."""
    try:
        result = read_result(folder)
        story = story_of(result)
        lines = [*check_files(folder, manifest=manifest), *check_figures(result, story.figures)]
        lines += check_detections(result)
        return lines + (_rescored(result, story, options) if options.rescore else [])
    except MiSplatError as error:
        hint = f" ({error.hint})" if error.hint else ""
        return [Check(name=str(folder), words=" ".join(f"{error}{hint}".split()), passed=False)]


def _rescored(result: Result, story: Story, options: ArtifactCheckOptions) -> list[Check]:
    """What detectors say today."""
    limit_threads((os.cpu_count() or 1) // 2)
    with progress("loading the detectors", total=None) as advance:
        names = options.detectors or tuple(fingerprints(result.record))
        detectors = load_detectors(names, options.weights)
        return rescore(
            result,
            story.rescoring,
            detectors,
            splats=options.splats,
            every=options.every,
            rate_tolerance=options.rate_tolerance,
            on_view=lambda done, total: advance(f"looking again, {done:,} of {total:,}"),
        )


def _tell(folder: Path, lines: list[Check]) -> None:
    for line in lines:
        show(f"{line.colour:5}  {line.name}: {line.words}")
    red = sum(line.passed is False for line in lines)
    show(f"{folder}: {red} of {len(lines)} lines are red.")
