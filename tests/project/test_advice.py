"""Commands that messages name: each exists, with the options that it is given, so that
advice can be followed.
"""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from attacks.cli import COMMANDS, command_of, parser_of

ROOT = Path(__file__).resolve().parents[2]
FILES = sorted(
    path for folder in ("mi_splat", "attacks") for path in (ROOT / folder).rglob("*.py")
)
NAMED = re.compile(r"(?:mi-splat|python -m attacks) ([a-z][a-z-]*)([^`;,()]*)")
FLAG = re.compile(r"(?<![\w-])--[a-z][a-z-]*")
PROSE = {"has", "needs", "ships"}
"""Words after the name of the program in sentences about it."""
ERRORS = {"of", "hinted", "message", "warn"}
OF_KINDS = {"--label"}
"""Options that `poison` has with some of its kinds."""
OF_OTHERS = {"--upgrade", "--user", "--flatten", "--privileged"}
"""Options of pip, usdcat and others that messages name."""
ALL_COMMANDS = {"--help", "--version", "--max-pixels", "--completion"}
"""Options that stand before any command."""


def test_messages_name_commands_that_exist() -> None:
    wrong = []
    for where, text in _messages():
        for name, rest in NAMED.findall(text):
            if name in PROSE:
                continue
            if name == "help":
                name, _, rest = rest.strip().partition(" ")
            if name not in COMMANDS:
                wrong.append(f"{where}: no command {name!r} in {text[:80]!r}")
                continue
            unknown = [
                flag
                for flag in FLAG.findall(rest)
                if flag not in _flags(_mode(name, rest))
            ]
            wrong += [f"{where}: {name} has no {flag}" for flag in unknown]
    assert not wrong, "\n".join(wrong)


def test_errors_name_options_that_exist() -> None:
    known = {flag for name in COMMANDS for flag in _flags(name)} | OF_OTHERS | OF_KINDS
    wrong = [
        f"{where}: {flag}"
        for where, text in _errors()
        for flag in FLAG.findall(text)
        if flag not in known
    ]
    assert not wrong, "\n".join(wrong)


@pytest.mark.parametrize("text", ["`mi-splat fly YOUR.ply`", "`mi-splat info --wings`"])
def test_advice_that_cannot_be_followed_would_be_found(text: str) -> None:
    ((name, rest),) = NAMED.findall(text)
    assert name not in COMMANDS or not set(FLAG.findall(rest)) <= _flags(name)


def _mode(name: str, rest: str) -> str:
    return command_of([name, *rest.split()])[0]


def _flags(name: str) -> set[str]:
    known = _KNOWN.get(name)
    if known is None:
        actions = parser_of(name)._actions
        known = _KNOWN[name] = {
            flag for action in actions for flag in action.option_strings
        } | ALL_COMMANDS
    return known


_KNOWN: dict[str, set[str]] = {}


def _messages() -> Iterator[tuple[str, str]]:
    """Strings of the code that are no docstrings, and where they stand."""
    for path, tree in _trees(NAMED):
        told = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
        yield from _strings(path, tree, told)


def _errors() -> Iterator[tuple[str, str]]:
    """Strings that errors, hints and warnings are made of, where these are written in
    the call.
    """
    for path, tree in _trees(FLAG):
        for node in ast.walk(tree):
            if (
                isinstance(node, ast.Call)
                and getattr(node.func, "attr", getattr(node.func, "id", "")) in ERRORS
            ):
                yield from _strings(path, node, set())


def _trees(looked_for: re.Pattern[str]) -> Iterator[tuple[Path, ast.Module]]:
    """The files in which something may be found; to parse all takes seconds."""
    for path in FILES:
        text = path.read_text()
        if looked_for.search(text):
            yield path, ast.parse(text)


def _strings(path: Path, tree: ast.AST, without: set[int]) -> Iterator[tuple[str, str]]:
    parts = {
        id(part)
        for node in ast.walk(tree)
        if isinstance(node, ast.JoinedStr)
        for part in node.values
    }
    for node in ast.walk(tree):
        where = f"{path.relative_to(ROOT)}:{getattr(node, 'lineno', 0)}"
        if isinstance(node, ast.JoinedStr):
            yield (
                where,
                "".join(
                    str(part.value) if isinstance(part, ast.Constant) else "X"
                    for part in node.values
                ),
            )
        elif (
            isinstance(node, ast.Constant)
            and isinstance(node.value, str)
            and id(node) not in without | parts
        ):
            yield where, node.value
