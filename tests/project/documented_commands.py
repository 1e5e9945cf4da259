"""Every command that the documentation shows, and how each is run: at once and tiny, or
by night and small.

A command of `mi-splat` that is in no table here fails test_docs.py: whoever writes a
new one into a page says how it is run. Pages are run line by line in a folder of their
own, so a page can use what its earlier lines have made.
"""

import re
import shlex
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from attacks.cli import command_of

ROOT = Path(__file__).resolve().parents[2]

When = Literal["fast", "nightly", "never"]
Change = Callable[[list[str]], "list[str] | None"]
"""From the values that a flag has on the page, none if it is not there, to those that
it is run with; None: no flag.
"""

FAST = {
    *(
        "artifact",
        "artifact-check",
        "audit",
        "bench",
        "bound",
        "capture",
        "compare",
        "convert",
        "dagger",
        "dagger --region",
        "demo",
        "detect",
        "detectors",
        "evaluate",
        "gate",
        "info",
        "render",
        "report",
        "rows",
        "select",
        "train",
    ),
    *("--help", "cloak --forecast", "conform", "conform --export"),
}
"""Commands that are run by `make commands`, for every change."""
NIGHTLY = {
    *("cloak", "doctor", "view", "python"),
    *("study run pairs", "study run eot_pairs", "study run cloak"),
}
"""Commands that are run by `make nightly`, each with the whole page that it stands
on.
"""
NIGHTLY_PAGES = {
    "docs/viewing.md",
    "docs/transfer.md",
    "docs/how-to/run-on-a-cluster.md",
    "docs/rendering-studies.md",
}
"""Pages whose lines need what long lines have made, or whose short lines are also on
other pages.
"""
TUTORIAL = "docs/tutorials/attack-your-own-splat.md"
WALKED_PAGES = {"docs/how-to/photographs.md", TUTORIAL}
"""Pages that nightly tests of their own run whole:
tests/preparation/test_photographs_of_a_phone.py.
"""
ELSEWHERE = {
    "make test": "runs these tests",
    "make docs": (
        ".ci/run runs it, and by night tests/project/test_docs.py looks at what it has"
        " built"
    ),
    "docs/examples": (
        "tests/project/test_examples.py runs them, and compares their images"
    ),
    "make nightly": "runs these tests",
    "make commands": "the same",
    "make demo-real": (
        "fetches photographs of others; tests/preparation runs its commands on some of"
        " our own"
    ),
    "study": (
        "tests/studies/test_shipped.py plans every study that is shipped; one of each"
        " kind is done by night"
    ),
    "detectors --get": (
        "tests/detectors/graphs/test_packages.py runs it, with an npm of its own"
    ),
    "detectors --from": "the same",
    "splat-conformance": (
        "tests/rendering/test_splat_conformance.py runs what its wheel holds"
    ),
    "source": "tests/cli/test_set_up.py runs the completion of a shell",
    "pip": (
        "the tests run in what it has installed; the extras that it names are checked"
    ),
}
"""Commands that are run by something else."""


@dataclass(frozen=True, slots=True)
class Line:
    """A command, as words, on a page: its path in the repository."""

    page: str
    words: tuple[str, ...]

    @property
    def program(self) -> str:
        """Name of the program, without a folder before it."""
        return self.words[0].rpartition("/")[2]

    @property
    def command(self) -> str:
        """The command of `mi-splat`, or its mode."""
        return command_of(self.words[1:])[0]

    @property
    def kind(self) -> str:
        """What the tables above call it."""
        if self.program != "mi-splat":
            if self.program == "make":
                return " ".join(self.words[:2])
            if self.words[1].startswith("docs/examples/"):
                return "docs/examples"
            return self.program
        if "--help" in self.words:
            return "--help"
        if self.command != self.words[1]:
            return self.command
        if self.words[1] == "study":
            kind = f"study {self.words[2]} {Path(self.words[3]).stem}"
            if kind in NIGHTLY:
                return kind
            return "study"
        marked = next(
            (
                flag
                for flag in ("--export", "--forecast", "--get", "--from")
                if flag in self.words
            ),
            None,
        )
        if marked:
            return f"{self.words[1]} {marked}"
        return self.words[1]

    @property
    def when(self) -> When | None:
        """When it is run; None if no table says it."""
        if self.kind in ELSEWHERE or self.page in WALKED_PAGES:
            return "never"
        if self.kind in FAST and self.page not in NIGHTLY_PAGES:
            return "fast"
        if self.kind in NIGHTLY | FAST or self.program == "make":
            return "nightly"
        return None

    def __str__(self) -> str:
        return f"{self.page}: {shlex.join(self.words)}"


def blocks(language: str, text: str) -> list[str]:
    """Contents of the fenced blocks in one language."""
    return re.findall(
        rf"^```{language}\n(.*?)^```$", text, flags=re.MULTILINE | re.DOTALL
    )


def pages() -> list[Path]:
    """The README and every page of the documentation; results have tables of their
    own, and the pages of examples are written by a program.
    """
    docs = ROOT / "docs"
    others = {docs / "artifacts", docs / "bench", docs / "examples"}
    return [
        ROOT / "README.md",
        *(path for path in sorted(docs.rglob("*.md")) if not others & {*path.parents}),
    ]


def lines() -> Iterator[Line]:
    """Every line of every shell block."""
    for path in pages():
        for block in blocks("sh", path.read_text()):
            for line in block.replace("\\\n", " ").splitlines():
                words = shlex.split(line, comments=True)
                if words:
                    yield Line(path.relative_to(ROOT).as_posix(), tuple(words))


def to(*values: str) -> Change:
    """These values, whether or not the page has the flag."""
    return lambda old: list(values)


def if_there(*values: str) -> Change:
    """These values where the page has the flag."""
    return lambda old: list(values) if old else None


def fewer_cameras(most: int) -> Change:
    """Sets of at most so many cameras; other cameras stay."""

    def change(old: list[str]) -> list[str] | None:
        sets = [
            re.sub(r":(\d+)", lambda match: f":{min(most, int(match[1]))}", word)
            for word in old
        ]
        return [
            re.sub(r"^grid:\d+x\d+$", f"grid:{most}x1", word) for word in sets
        ] or None

    return change


def of_iterations(factor: float) -> Change:
    """A part of the iterations, so that a longer run stays longer; of 3,000 where the
    page says nothing.
    """
    return lambda old: [str(max(5, round(int((old or ["3000"])[0]) * factor)))]


TINY: dict[str, dict[str, Change]] = {
    "capture": {
        "--cameras": lambda old: fewer_cameras(4)(old or ["hemisphere:4"]),
        "--size": to("32"),
        "--samples": to("1"),
        "--points": to("300"),
        "--test": if_there("2"),
    },
    "train": {
        "--iterations": of_iterations(0.001),
        "--eval-interval": to("0"),
        "--sh-degree": to("1"),
    },
    "render": {
        "--cameras": fewer_cameras(2),
        "--size": if_there("32"),
        "--samples": if_there("2"),
    },
    "compare": {
        "--cameras": lambda old: ["front"] if old == ["all"] else old,
        "--size": to("32"),
        "--rounds": to("1"),
    },
    "select": {"--cameras": fewer_cameras(2)},
    "detect": {"--cameras": fewer_cameras(1), "--size": to("64")},
    "dagger": {
        "--cameras": fewer_cameras(2),
        "--size": to("64"),
        "--steps": to("1"),
        "--noise-draws": to("1"),
    },
    "dagger --region": {
        "--size": to("64"),
        "--steps": to("1"),
        "--pool": to("1"),
        "--validation": to("1"),
        "--held-out": to("1"),
    },
    "evaluate": {
        "--cameras": fewer_cameras(2),
        "--size": to("64"),
        "--images": to("1"),
    },
    "view": {"--no-open": to()},
    "demo": {"--force": to()},
}
"""Name of a command to what is changed in it, so that it takes seconds; what counts is
that it runs.
"""

SHIPPED_WEIGHTS: dict[str, Change] = {
    "--detectors": if_there("fasterrcnn_small"),
    "--weights": to(
        str(ROOT / "attacks" / "detectors" / "fasterrcnn_small.safetensors")
    ),
}
"""For a line that names a file of weights, which nobody has here: those of the project,
given as a file.
"""

BENCHMARKS = {"benchmarks/render.py": ["--rounds", "1"]}
"""What is added to a program that a page calls by `python`."""


def shortened(line: Line) -> list[str]:
    """The words after `mi-splat`, with the changes that the tables ask for."""
    words = list(line.words[1:])
    changes = TINY.get(line.command, {})
    if "--weights" in words:
        changes = {**changes, **SHIPPED_WEIGHTS}
    for flag, change in changes.items():
        if "--help" in words:
            break
        start = words.index(flag) if flag in words else len(words)
        end = next(
            (i for i in range(start + 1, len(words)) if words[i].startswith("--")),
            len(words),
        )
        values = change(words[start + 1 : end])
        words[start:end] = [] if values is None else [flag, *values]
    return words
