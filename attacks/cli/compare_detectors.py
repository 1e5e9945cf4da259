"""`mi-splat compare-detectors`: the figures of several detectors side by side."""

from __future__ import annotations

from attacks.cli.evaluate_detector import check_suffix, write_tables
from attacks.cli.training_options import CompareDetectorsOptions
from attacks.detectors.evaluation.tables import comparison, read_figures
from mi_splat.cli.console import show
from mi_splat.errors import InvalidValueError, message
from mi_splat.io.folders import check_writable


def run(options: CompareDetectorsOptions) -> int:
    """Write and print one table of all detectors, and draw their recall."""
    if not options.figures:
        raise InvalidValueError(message("files", "at least one", "none", "name what `evaluate-detector` wrote"))
    check_writable(options.out.parent)
    check_suffix("--out", options.out, ".md")
    several = [read_figures(path) for path in options.figures]
    text = comparison(several)
    options.out.parent.mkdir(parents=True, exist_ok=True)
    written = write_tables(text, several, options.out)
    show(text)
    show(written)
    return 0
