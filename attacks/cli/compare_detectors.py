"""`mi-splat compare-detectors`: the figures of several detectors side by side."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from mi_splat import provenance
from mi_splat.cli.console import show
from mi_splat.cli.flags import Positional
from mi_splat.errors import InvalidValueError, message

EXAMPLES = ("compare-detectors out/detector/held-out.json out/centernet.json",)
SEE_ALSO = ("evaluate-detector", "detectors")


ENDING = ".compared.json"
"""Of the file with the figures; never that of a file of `mi-splat evaluate-detector`."""


@dataclass(frozen=True, slots=True, kw_only=True)
class CompareDetectorsOptions:
    """Put the figures of several detectors side by side: mAP, false positives, and recall by elevation."""

    figures: Positional[tuple[Path, ...]] = ()
    """Files that `mi-splat evaluate-detector` wrote; at least one."""
    out: Path = Path("out/detector/comparison.compared.json")
    """File for all figures, whose name ends in .compared.json; `mi-splat report` makes a page of it."""


def run(options: CompareDetectorsOptions) -> int:
    """Print one table of all detectors, and keep their figures in one file."""
    from attacks.detectors.evaluation.tables import comparison, read_figures
    from mi_splat.io.documents import save_json
    from mi_splat.io.folders import check_writable

    if not options.figures:
        raise InvalidValueError(message("files", "at least one", "none", "name what `evaluate-detector` wrote"))
    check_writable(options.out.parent)
    if not options.out.name.endswith(ENDING):
        do = f"for instance {options.out.with_suffix(ENDING)}"
        raise InvalidValueError(message("--out", f"a file name that ends in {ENDING}", str(options.out), do))
    several = [read_figures(path) for path in options.figures]
    options.out.parent.mkdir(parents=True, exist_ok=True)
    save_json({"compared": several, "files": list(map(str, options.figures)), **provenance.origin()}, options.out)
    show(comparison(several))
    show(f"{options.out}: every figure")
    return 0
