"""The options of the command that writes a page of results; light, so that --help is fast."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from mi_splat.cli.flags import Positional
from mi_splat.fields import Folder


@dataclass(frozen=True, slots=True, kw_only=True)
class ReportOptions:
    """Write one page of results: pictures, curves with intervals, controls, warnings, settings, and how to repeat it.

    Takes folders that mi-splat dagger, dagger-eot, study, dagger-sanity, evaluate, compare, detect and cloak have
    written, and the JSON files of evaluate-detector, compare-detectors and cloak-experiment. The page is one file
    without a script, and asks nothing of any network.
    """

    results: Positional[tuple[Folder, ...]] = ()
    """Folders or files of results; at least one. Those of one kind are compared."""
    out: Path = Path("out/report.html")
    """The page; its folder has to be there."""
    title: str | None = None
    """Heading of the page; None is made of the results."""
    force: bool = False
    """Replace the page if it is there."""
    json: bool = False
    """Print what is on the page as one JSON document on stdout."""
