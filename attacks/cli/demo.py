"""`mi-splat demo`: DAGGER on the car of the scene that travels with the package."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from mi_splat.cli.options import ResultOptions
from mi_splat.fields import Folder

EXAMPLES = ("demo", "demo --out out/first --force")


@dataclass(frozen=True, kw_only=True)
class DemoOptions(ResultOptions):
    """Attack the car of the scene example:car_street, so that a small Faster R-CNN reports a person in its place.

    The same as `mi-splat dagger example:car_street --object car --target person --cameras rear`. It needs neither a
    GPU nor a network, and takes about 20 seconds on two CPU cores. Writes what `mi-splat dagger` writes into --out;
    look at detections.png first.
    """

    out: Folder = Path("out/demo")


def run(options: DemoOptions) -> None:
    """Run DAGGER with the options of the demo."""
    from attacks.cli import dagger, parse

    words = ["example:car_street", "--object", "car", "--target", "person", "--cameras", "rear", "--out"]
    flags = [f"--{name}" for name in ("force", "json") if getattr(options, name)]
    dagger.run(parse("dagger", [*words, str(options.out), *flags]))
