"""Flags of a command out of the fields of its options, by the standard library's
argparse; light, without torch.

Options are a frozen dataclass. What a field takes it says itself (`mi_splat.fields`),
its help is the text below it or its entry under "Attributes:", and its default is the
flag's. A field that is a dataclass has its flags in a group.
"""

from __future__ import annotations

import argparse
import ast
import dataclasses
import inspect
import os
import re
import shutil
import sys
import textwrap
import typing
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Literal, NoReturn, TypeVar

from mi_splat.cli.console import UsageError
from mi_splat.errors import InvalidValueError, nearest
from mi_splat.fields import (
    Converter,
    FieldError,
    Metavar,
    Range,
    check_choice,
    field_type,
    taken,
    type_hints,
)

_Type = TypeVar("_Type")

NONE = "none"
"""Stands for None, or for an empty tuple."""
DEFAULT = " Default: "
"""Begins the last sentence of a field whose default is None or an empty tuple: what
that stands for, which `--help` prints as the default.
"""
METAVARS = {int: "COUNT", float: "NUMBER", str: "NAME", Path: "FILE"}
"""Names of values whose field declares none."""


@dataclass(frozen=True, slots=True)
class Flag:
    """How a field is given on the command line."""

    name: str = ""  # name of the flag; that of the field if empty
    positional: bool = False  # whether it is given without any flag, by its position


Positional = Annotated[_Type, Flag(positional=True)]
"""A field that is given by its position."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Option:
    """A field as the command line has it."""

    key: str  # dotted names of the fields that lead to it
    hint: Any  # its type, with its marks
    default: Any  # `dataclasses.MISSING` if it is required
    text: str

    def mark(self, kind: type[_Type]) -> _Type | None:
        """What the field declares of itself."""
        return next(
            (mark for mark in field_type(self.hint).marks if isinstance(mark, kind)),
            None,
        )

    @property
    def given(self) -> Flag:
        """How the value is given."""
        return self.mark(Flag) or Flag()

    @property
    def parts(self) -> tuple[Any, ...]:
        """The types of its values where it is a tuple."""
        kind = field_type(self.hint).kind
        if typing.get_origin(kind) is tuple:
            return typing.get_args(kind)
        return ()

    @property
    def name(self) -> str:
        """Name of the field."""
        return self.key.rpartition(".")[2]

    @property
    def flag(self) -> str:
        """The flag, or the name of a positional value."""
        no = "no-" if self.default is True else ""
        name = f"--{no}{self.given.name or self.name}".replace("_", "-")
        if self.given.positional:
            return self.metavar
        return name

    @property
    def fields(self) -> list[Option]:
        """The options of a dataclass."""
        if not dataclasses.is_dataclass(self.default):
            return []
        values = {
            field.name: getattr(self.default, field.name)
            for field in dataclasses.fields(self.default)
        }
        return _options(type(self.default), values, f"{self.key}.")

    @property
    def metavar(self) -> str:
        """What its values are called."""
        declared = self.mark(Metavar)
        allowed = self.mark(Range)
        if declared is not None:
            return declared.name
        kind, marks = field_type(self.hint)[:2]
        if self.parts:
            return dataclasses.replace(
                self, hint=Annotated[(self.parts[0], Flag(), *marks)]
            ).metavar
        if typing.get_origin(kind) is Literal:
            return f"{{{','.join(map(str, typing.get_args(kind)))}}}"
        if allowed is not None and allowed.unit.isalpha():
            return allowed.unit.upper()
        return METAVARS.get(kind, "VALUE")

    @property
    def count(self) -> int | str | None:
        """How many words it takes, as argparse has it."""
        if self.parts and not self.mark(Converter):
            if self.parts[-1] is Ellipsis:
                return "*"
            return len(self.parts)
        if self.given.positional and self.default is not dataclasses.MISSING:
            return "?"
        return None

    @property
    def help(self) -> str:
        """Its text, the numbers that it takes, and its default."""
        inner = field_type(self.parts[0]).marks if self.parts else ()
        allowed = self.mark(Range) or next(
            (mark for mark in inner if isinstance(mark, Range)), Range()
        )
        if not allowed.unit or allowed.unit.upper() == self.metavar:
            unit = ""
        else:
            unit = f" {allowed.unit}"
        notes = [f"{allowed.bounds}{unit}"] if allowed.bounds else []
        text, _, default_text = self.text.partition(DEFAULT)
        if self.default is dataclasses.MISSING:
            notes.append("required")
        elif isinstance(self.default, bool):
            # the text of a field that is on says after its flag what that turns off
            _, _, off = text.partition(f"{self.flag}: ")
            text = f"{off[:1].upper()}{off[1:]}" or text
        elif not self.is_unset:
            notes.append(f"default: {self.written(self.default)}")
        elif default_text:
            notes.append(f"default: {default_text.rstrip('.')}")
        words = f"{text} ({'; '.join(notes)})" if notes else text
        return words.replace("%", "%%")

    @property
    def is_unset(self) -> bool:
        """Whether its default stands for something that only its text can say."""
        return self.default is None or self.default == ()

    def written(self, value: Any) -> str:
        """A value as the command line has it."""
        converter = self.mark(Converter)
        if value is None or value == ():
            return NONE
        if converter is not None:
            return converter.write(value)
        if isinstance(value, tuple):
            return " ".join(map(str, value))
        return str(value)

    def value(self, words: Sequence[str], flag: str) -> Any:
        """The value in the user's words."""
        kind, _, optional = field_type(self.hint)[:3]
        if [word.lower() for word in words] == [NONE] and (
            optional or self.count == "*"
        ):
            if optional:
                return None
            return ()
        converter = self.mark(Converter)
        if converter is not None:
            try:
                return taken(self.hint, converter.read(words[0]), flag)
            except ValueError as error:
                raise (
                    error.at(flag)
                    if isinstance(error, FieldError)
                    else UsageError(f"{flag}: {error}")
                ) from None
        values = tuple(
            _plain(self.parts[0] if self.parts else kind, word) for word in words
        )
        return taken(self.hint, values if self.parts else values[0], flag)


def _plain(hint: Any, word: str) -> Any:
    """A word as the number or the choice that it stands for; the word itself where it
    stands for none.
    """
    kind = field_type(hint).kind
    if typing.get_origin(kind) is Literal:
        return next(
            (choice for choice in typing.get_args(kind) if str(choice) == word), word
        )
    if kind in (int, float):
        for number in (int, kind):
            try:
                return number(word)
            except ValueError:
                continue
    return word


class Parser(argparse.ArgumentParser):
    """A parser whose errors are exceptions."""

    def error(self, message: str) -> NoReturn:
        """Raise what argparse would print."""
        raise UsageError(message.removeprefix("argument "))


def parser_of(
    kind: type,
    *,
    program: str,
    description: str,
    defaults: Mapping[str, Any] | None = None,
) -> Parser:
    """The parser of a command's options."""
    width = min(shutil.get_terminal_size().columns, 110)
    options = options_of(kind, defaults)
    words = []
    for option in options:
        if option.given.positional:
            word = f"{option.metavar} ..." if option.count == "*" else option.metavar
            words.append(word if option.default is dataclasses.MISSING else f"[{word}]")
    parser = Parser(
        prog=program,
        usage=" ".join([program, "[-h] [OPTIONS]", *words]),
        description=_filled(description, width),
        formatter_class=lambda prog: argparse.RawDescriptionHelpFormatter(
            prog, width=width
        ),
        allow_abbrev=False,
        argument_default=argparse.SUPPRESS,
    )
    # argparse takes -1e5 and -y for flags
    parser._negative_number_matcher = re.compile(r"-(\.?\d.*|inf|[xyz])$")
    _add(parser, parser, options, width)
    return parser


def parse(
    kind: type[_Type],
    words: Sequence[str],
    *,
    program: str,
    description: str = "",
    defaults: Mapping[str, Any] | None = None,
) -> _Type:
    """The options in the user's words; ends the process for --help."""
    parser = parser_of(
        kind, program=program, description=description, defaults=defaults
    )
    end = words.index("--") if "--" in words else len(words)
    paths = [f"./{word}" if word.startswith("-") else word for word in words[end + 1 :]]
    given, rest = parser.parse_known_intermixed_args(
        [*map(_dashed, words[:end]), *paths]
    )
    if rest:
        flags = [flag for action in parser._actions for flag in action.option_strings]
        unknown = next(
            (word for word in rest if word.startswith("-")), rest[0]
        ).partition("=")[0]
        if unknown.startswith("-"):
            do = nearest(unknown, flags, f"see {program} --help")
        else:
            do = "leave it out"
        raise UsageError.of("options", "those of the command", " ".join(rest), do)
    try:
        return _built(kind, options_of(kind, defaults), vars(given))
    except InvalidValueError as error:
        raise UsageError(str(error)) from None


def choice_among(
    names: Collection[str], words: Sequence[str], flag: str, default: str
) -> str:
    """The name behind a flag that other flags depend on, read before all others."""
    name = default
    for word, following in zip(words, [*words[1:], ""], strict=False):
        if word.partition("=")[0] == flag:
            name = word.partition("=")[2] or following
    try:
        check_choice(flag, name, names)
    except InvalidValueError as error:
        raise UsageError(str(error)) from None
    return name


def _dashed(word: str) -> str:
    """A word whose flag has dashes."""
    flag, equals, value = word.partition("=")
    if flag.startswith("--"):
        return f"{flag.replace('_', '-')}{equals}{value}"
    return word


def options_of(kind: type, defaults: Mapping[str, Any] | None = None) -> list[Option]:
    """The options of a command: those of the class itself first, then those that it
    shares with other commands.
    """
    bases = reversed([*enumerate(kind.__mro__)])
    ranks = {
        name: rank for rank, base in bases for name in inspect.get_annotations(base)
    }
    values = {
        field.name: (
            field.default
            if field.default_factory is dataclasses.MISSING
            else field.default_factory()
        )
        for field in sorted(
            dataclasses.fields(kind), key=lambda field: ranks[field.name]
        )
    }
    return _options(kind, {**values, **(defaults or {})})


def _options(kind: type, values: Mapping[str, Any], key: str = "") -> list[Option]:
    hints = type_hints(kind)
    texts = field_texts(kind)
    return [
        Option(
            key=f"{key}{name}",
            hint=hints[name],
            default=default,
            text=texts.get(name, ""),
        )
        for name, default in values.items()
    ]


def _add(parser: Parser, group: Any, options: Sequence[Option], width: int) -> None:
    """Add options to a group of a parser, or to itself; those of a dataclass are a
    group of their own.
    """
    for option in options:
        if dataclasses.is_dataclass(option.default):
            title = f"{option.key.replace('_', ' ')} options"
            _add(
                parser,
                parser.add_argument_group(title, _filled(option.text, width - 2)),
                option.fields,
                width,
            )
        elif option.given.positional:
            group.add_argument(
                option.key,
                nargs=option.count or "?",
                metavar=option.metavar,
                help=option.help,
            )
        elif isinstance(option.default, bool):
            const = not option.default
            group.add_argument(
                option.flag,
                dest=option.key,
                action="store_const",
                const=const,
                help=option.help,
            )
        else:
            names: Any = tuple(option.metavar.split())
            metavar = names if len(names) == option.count else option.metavar
            group.add_argument(
                option.flag,
                dest=option.key,
                nargs=option.count,
                metavar=metavar,
                help=option.help,
            )


def _built(
    kind: type[_Type], options: Sequence[Option], given: Mapping[str, Any]
) -> _Type:
    """A dataclass of what was given, by the keys of options, and of defaults."""
    values: dict[str, Any] = {}
    for option in options:
        words = given.get(option.key)
        if dataclasses.is_dataclass(option.default):
            values[option.name] = _built(type(option.default), option.fields, given)
        elif isinstance(words, bool):
            values[option.name] = words
        elif words not in (None, []):
            values[option.name] = option.value(
                [words] if isinstance(words, str) else words, option.flag
            )
        elif option.default is dataclasses.MISSING:
            what = "arguments" if option.given.positional else option.flag
            raise UsageError.of(what, option.metavar, "none", "add it")
        else:
            # the flag of a tuple, and nothing behind it
            is_empty = option.key in given and not option.given.positional
            values[option.name] = () if is_empty else option.default
    try:
        return kind(**values)
    except FieldError as error:
        flags = {option.name: option.flag for option in options}
        raise error.at(flags.get(error.what, error.what)) from None


@cache
def field_texts(kind: Any) -> dict[str, str]:
    """What each field of a dataclass means: the text below it, or its entry under
    "Attributes:".
    """
    texts: dict[str, str] = {}
    for base in reversed(kind.__mro__):
        if "__dataclass_fields__" in vars(base):
            section = (
                (inspect.getdoc(base) or "")
                .partition("\nAttributes:\n")[2]
                .partition("\n\n")[0]
            )
            texts |= dict(
                re.findall(
                    r"^ {4}(\w+): (.*(?:\n {5,}.*)*)", section, flags=re.MULTILINE
                )
            )
            texts |= _below(base.__module__, base.__name__)
    return {name: " ".join(text.split()) for name, text in texts.items()}


def _below(module: str, kind: str) -> dict[str, str]:
    """The texts below the fields of a dataclass in its source."""
    for node in _source(module).body:
        if isinstance(node, ast.ClassDef) and node.name == kind:
            return {
                field.target.id: text.value.value
                for field, text in zip(node.body, node.body[1:], strict=False)
                if isinstance(field, ast.AnnAssign)
                and isinstance(field.target, ast.Name)
                if isinstance(text, ast.Expr) and isinstance(text.value, ast.Constant)
                if isinstance(text.value.value, str)
            }
    return {}


@cache
def _source(module: str) -> ast.Module:
    path = sys.modules[module].__file__
    if path and os.path.isfile(path):
        return ast.parse(Path(path).read_text("utf-8"))
    return ast.Module([], [])


def _filled(text: str, width: int) -> str:
    """Paragraphs filled, but for those whose second line is indented, as examples
    are.
    """
    paragraphs = re.split(r"\n\s*\n", text)
    return "\n\n".join(
        part if "\n  " in part else textwrap.fill(" ".join(part.split()), width)
        for part in paragraphs
    )
