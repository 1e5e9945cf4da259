"""The options of a command from the words that the user typed, and its `--help`."""

from __future__ import annotations

import importlib
import inspect
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from attacks.cli.examples import ALIASES, EXAMPLES, SEE_ALSO
from mi_splat.cli import flags
from mi_splat.cli.console import PROGRAM, UsageError
from mi_splat.cli.values import as_one_word
from mi_splat.errors import InvalidValueError

if TYPE_CHECKING:
    import argparse

    from attacks.cli import Command


def parse(name: str, command: Command, words: Sequence[str]) -> Any:
    """The options of a command as its frozen dataclass; ends the process for --help.

    Args:
        name: Of the command.
        command: Where its options are.
        words: What the user typed after its name.

    Raises:
        UsageError: The words are no options of the command, or a number is out of its range.
    """
    given = as_one_word([_canonical(word, ALIASES.get(name, {})) for word in words])
    try:
        kind, defaults = _options(command, given)
    except InvalidValueError as error:
        raise UsageError(str(error)) from None
    return flags.parse(kind, given, program=f"{PROGRAM} {name}", description=description(name, kind), defaults=defaults)


def argument_parser(name: str, command: Command) -> argparse.ArgumentParser:
    """The options of a command as a parser, from which documentation can be written.

    Args:
        name: Of the command.
        command: Where its options are.
    """
    kind, defaults = _options(command, ())
    return flags.parser_of(kind, program=f"{PROGRAM} {name}", description=inspect.getdoc(kind) or "", defaults=defaults)


def _options(command: Command, words: Sequence[str]) -> tuple[type, Mapping[str, Any]]:
    """The dataclass of a command's options, and defaults that depend on the words."""
    module = importlib.import_module(f"{command.package}.{command.options_module}")
    return getattr(module, command.options), getattr(module, command.defaults)(words) if command.defaults else {}


def description(name: str, kind: type) -> str:
    """What `--help` says above the options: what the command does, examples, and commands that go with it.

    Args:
        name: Of the command.
        kind: Its options; their docstring says what the command does.
    """
    parts = [inspect.getdoc(kind) or ""]
    if EXAMPLES.get(name):
        parts.append("\n".join(["Examples:", *(f"  {PROGRAM} {line}" for line in EXAMPLES[name])]))
    if SEE_ALSO.get(name):
        parts.append("See also: " + ", ".join(f"{PROGRAM} {other}" for other in SEE_ALSO[name]))
    return "\n\n".join(parts)


def _canonical(word: str, aliases: Mapping[str, str]) -> str:
    """A word with the name of an option in the place of another name for it; --a-b and --a_b are the same."""
    flag, equals, value = word.partition("=")
    name = flag.removeprefix("--").replace("-", "_")
    return f"--{aliases[name]}{equals}{value}" if flag.startswith("--") and name in aliases else word
