"""Which part of the project may import which: the layers from the bottom up, and the
modules in each.

A module may import from its own layer and from those below it; no two modules may
import each other, not even by way of others. `python -m tests.project.layers` writes
the image of it, docs/structure.md.
"""

import ast
import graphlib
from collections.abc import Iterator
from functools import cache
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = ("mi_splat", "attacks")
DIAGRAM = ROOT / "docs" / "structure.md"

LAYERS: dict[str, tuple[str, ...]] = {
    "values": (
        "mi_splat.errors",
        "mi_splat.fields",
        "mi_splat.attributes",
        "mi_splat._lazy",
        "mi_splat.registry",
        "mi_splat.provenance",
        "mi_splat.import_closure",
        "mi_splat.oracle",
        "mi_splat.conformance",
        "mi_splat.scene",
        "mi_splat.processes",
        "mi_splat.process_group",
        "mi_splat.group_member",
        "mi_splat.maths",
    ),
    "cameras": (
        "mi_splat.cameras",
        "mi_splat.cameras.camera",
        "mi_splat.cameras.directions",
        "mi_splat.cameras.framing",
        "mi_splat.cameras.rooms",
    ),
    "files": ("mi_splat.io",),
    "ledger": ("mi_splat.ledger",),
    "selection": ("mi_splat.selection",),
    "data sets": (
        "mi_splat.datasets",
        "mi_splat.cameras.forms",
        "mi_splat.cameras.sets",
    ),
    "preparation": ("mi_splat.preparation",),
    "objects": ("scenes.recipes.objects",),
    "rasterizer": (
        "mi_splat.render",
        "mi_splat.render.settings",
        "mi_splat.render.tile",
    ),
    "ray tracer": ("mi_splat.render.ray",),
    "Mitsuba": (
        "mi_splat.render.setup",
        "mi_splat.render.plugins",
        "mi_splat.render.variant",
    ),
    "rendering": (
        "mi_splat.render.renderer",
        "mi_splat.render.frozen_view",
        "mi_splat.render.view_freezing",
        "mi_splat.render.overdraw",
        "mi_splat.render.volprim",
        "mi_splat.render.scene_files",
    ),
    "comparison": ("mi_splat.comparison",),
    "training": ("mi_splat.training",),
    "audit": ("mi_splat.audit",),
    "capture": ("mi_splat.capture",),
    "viewer": ("mi_splat.viewer",),
    "commands of mi_splat": ("mi_splat.cli",),
    "interfaces of attacks": (
        "attacks.figures.rate",
        "attacks.figures.tables",
        "attacks.threats",
        "attacks.optimisers",
        "attacks.search",
        "attacks.detectors.base",
        "attacks.objectives",
    ),
    "detectors": ("attacks.detectors",),
    "classifiers": ("attacks.classifiers",),
    "subset": ("attacks.gaussian_subset",),
    "transformations": ("attacks.transformations",),
    "observation": ("attacks.observe", "attacks.figures"),
    "attacks": ("attacks.dagger", "attacks.cloak", "attacks.poisons", "attacks.audits"),
    "test kit": ("attacks.testing",),
    "studies": ("attacks.studies",),
    "scoreboard": ("attacks.bench",),
    "reports": ("attacks.report",),
    "command line": ("attacks.cli", "attacks.__main__"),
}


@cache
def modules(package: str) -> dict[str, Path]:
    """Dotted name to file of every module of a package."""
    paths = {}
    for path in sorted((ROOT / package).rglob("*.py")):
        parts = path.relative_to(ROOT).with_suffix("").parts
        paths[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return paths


def imports(name: str, path: Path) -> Iterator[str]:
    """Dotted names of what a module imports when it runs, type checking apart."""
    tree = ast.parse(path.read_text())
    typing_only = {
        id(inner)
        for node in ast.walk(tree)
        if isinstance(node, ast.If) and ast.unparse(node.test).endswith("TYPE_CHECKING")
        for inner in ast.walk(node)
    }
    for node in ast.walk(tree):
        if id(node) in typing_only:
            continue
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{name} has a relative import"
            assert node.module is not None
            if node.module.split(".")[0] in PACKAGES:
                known = modules(node.module.split(".")[0])
            else:
                known = {}
            for alias in node.names:
                full = f"{node.module}.{alias.name}"
                yield full if full in known else node.module


@cache
def edges(package: str) -> tuple[tuple[str, str], ...]:
    """Pairs (module, what it imports) of a package."""
    return tuple(
        (name, other)
        for name, path in modules(package).items()
        for other in imports(name, path)
        if other != name
    )


def layer_of(name: str) -> tuple[int, str] | None:
    """Number of a module's layer and the entry of `LAYERS` that it belongs to; the
    longest matching entry counts.
    """
    matches = [
        (len(entry), number, entry)
        for number, entries in enumerate(LAYERS.values())
        for entry in entries
        if name == entry or name.startswith(entry + ".")
    ]
    if matches:
        return max(matches)[1:]
    return None


def circle() -> list[str]:
    """Modules that import each other in a circle; empty if there are none."""
    known = {name for package in PACKAGES for name in modules(package)}
    graph: dict[str, set[str]] = {}
    for name, other in (edge for package in PACKAGES for edge in edges(package)):
        if other in known:
            graph.setdefault(name, set()).add(other)
    try:
        graphlib.TopologicalSorter(graph).prepare()
    except graphlib.CycleError as error:
        return list(error.args[1])
    return []


def diagram() -> str:
    """The layers and the imports between them, as an image that Mermaid draws."""
    needs: dict[str, set[str]] = {}
    for package in PACKAGES:
        for name, other in edges(package):
            here = layer_of(name)
            there = layer_of(other)
            if here and there and here[0] != there[0]:
                titles = list(LAYERS)
                needs.setdefault(titles[here[0]], set()).add(titles[there[0]])
    reach: dict[str, set[str]] = {}
    for title in LAYERS:  # from the bottom up, so that what lies below is done
        reach[title] = set().union(
            *({low} | reach[low] for low in needs.get(title, set())), set()
        )
    lines = ["# Architecture", "", _INTRODUCTION, "", "```mermaid", "flowchart BT"]
    names = {title: f"L{number}" for number, title in enumerate(LAYERS)}
    for title, entries in LAYERS.items():
        shown = "<br/>".join(
            entry.removeprefix("mi_splat.")
            for entry in entries
            if not entry.endswith("_lazy")
        )
        lines.append(f'    {names[title]}["<b>{title}</b><br/>{shown}"]')
    for title in LAYERS:
        below: set[str] = needs.get(title, set())
        implied = set().union(*(reach[low] for low in below), set())
        lines += [
            f"    {names[low]} --> {names[title]}"
            for low in LAYERS
            if low in below - implied
        ]
    lines.append("```")
    return "\n".join(lines) + "\n"


_INTRODUCTION = (
    "Imports run one way, from the command line at the top down to the values, without"
    " cycles; a test enforces this. An arrow points from an imported layer to the layer"
    " that imports it; arrows that follow from others are left out. This page is"
    " generated by `python -m tests.project.layers`."
)

if __name__ == "__main__":
    DIAGRAM.write_text(diagram())
