"""`mi-splat compare-detectors`: the figures of several detectors side by side."""

from __future__ import annotations

from attacks.cli.evaluate_detector import check_suffix, write_tables
from attacks.cli.training_options import CompareDetectorsOptions
from attacks.detectors.evaluation.tables import comparison, read_figures
from mi_splat import provenance
from mi_splat.cli.console import show
from mi_splat.errors import InvalidValueError, message
from mi_splat.io.documents import save_json
from mi_splat.io.folders import check_writable

RECORD = ".compared.json"
"""Ending of the file with the figures; never that of a file of `mi-splat evaluate-detector`."""


def run(options: CompareDetectorsOptions) -> int:
    """Write and print one table of all detectors, draw their recall, and keep their figures in one file."""
    if not options.figures:
        raise InvalidValueError(message("files", "at least one", "none", "name what `evaluate-detector` wrote"))
    check_writable(options.out.parent)
    check_suffix("--out", options.out, ".md")
    several = [read_figures(path) for path in options.figures]
    text = comparison(several)
    options.out.parent.mkdir(parents=True, exist_ok=True)
    written = write_tables(text, several, options.out)
    record = options.out.with_suffix(RECORD)
    save_json({"compared": several, "files": list(map(str, options.figures)), **provenance.origin()}, record)
    show(text)
    show(f"{written}; {record}: every figure")
    return 0
