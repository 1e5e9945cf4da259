"""Flags of a command out of the fields of its options, by the standard library's argparse; light, without torch.

Options are a frozen dataclass. What a field takes it says itself (`mi_splat.fields`), its help is the text below it or
its entry under "Attributes:", and its default is the flag's. A field that is a dataclass has its flags in a group.
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
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Literal, NoReturn, TypeVar

from mi_splat.cli.console import UsageError
from mi_splat.errors import InvalidValueError, nearest
from mi_splat.fields import Converter, FieldError, Metavar, Range, named_path, taken, type_hints, unwrapped

_Type = TypeVar("_Type")

NONE = "none"
"""Stands for None, or for an empty tuple."""
CALLED = {int: "COUNT", float: "NUMBER", str: "NAME", Path: "FILE"}
"""What a value is called that says nothing else of itself."""
_NEGATIVE = re.compile(r"-(\.?\d.*|inf)")


@dataclass(frozen=True, slots=True)
class Flag:
    """How a field is given on the command line."""

    name: str = ""  # name of the flag; that of the field if empty
    aliases: tuple[str, ...] = ()  # other names for it
    positional: bool = False  # whether it is given without any flag, by its position
    prefixed: bool = True  # whether the flags of a dataclass have its field's name before theirs


Positional = Annotated[_Type, Flag(positional=True)]
"""A field that is given by its position."""
Unprefixed = Annotated[_Type, Flag(prefixed=False)]
"""A dataclass whose flags stand for themselves."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Option:
    """A field as the command line has it."""

    key: str  # dotted names of the fields that lead to it
    hint: Any  # its type, with what it says of its values
    default: Any  # of it; `dataclasses.MISSING` if it has to be given
    text: str  # what it means
    prefix: str = ""  # what is before the name of its flag

    @property
    def how(self) -> Flag:
        """How the value is given on the command line."""
        return next((mark for mark in unwrapped(self.hint)[1] if isinstance(mark, Flag)), Flag())

    @property
    def flag(self) -> str:
        """The flag, or what the value is called if it has none."""
        no = "no-" if self.default is True else ""
        name = f"--{self.prefix}{no}{self.how.name or self.name}".replace("_", "-")
        return self.called if self.how.positional else name

    @property
    def name(self) -> str:
        """Name of the field."""
        return self.key.rpartition(".")[2]

    @property
    def parts(self) -> list[Option]:
        """The options of its fields where it is a dataclass.

        Its name is before those of their flags, but within an unprefixed one.
        """
        if not dataclasses.is_dataclass(self.default):
            return []
        is_within = not self.prefix and "." in self.key
        prefix = self.prefix if is_within or not self.how.prefixed else f"{self.prefix}{self.name}."
        values = {field.name: getattr(self.default, field.name) for field in dataclasses.fields(self.default)}
        return _options(type(self.default), values, f"{self.key}.", prefix)

    @property
    def called(self) -> str:
        """What its values are called."""
        kind, marks, _ = unwrapped(self.hint)
        words = next((mark.name for mark in marks if isinstance(mark, Metavar)), "")
        unit = next((mark.unit for mark in marks if isinstance(mark, Range)), "")
        if typing.get_origin(kind) is tuple:
            inner = dataclasses.replace(self, hint=Annotated[(typing.get_args(kind)[0], Flag(), *marks)])
            return words or inner.called
        if typing.get_origin(kind) is Literal:
            return f"{{{','.join(map(str, typing.get_args(kind)))}}}"
        return words or (unit.upper() if unit.isalpha() else CALLED.get(kind, "VALUE"))

    @property
    def count(self) -> int | str | None:
        """How many words it takes, as argparse has it."""
        kind, marks, _ = unwrapped(self.hint)
        required = self.default is dataclasses.MISSING
        if typing.get_origin(kind) is tuple and not any(isinstance(mark, Converter) for mark in marks):
            parts = typing.get_args(kind)
            return "*" if parts[-1] is Ellipsis else len(parts)
        return "?" if self.how.positional and not required else None

    @property
    def help(self) -> str:
        """What `--help` says of it: its text, the numbers that it takes, its default."""
        kind, marks, _ = unwrapped(self.hint)
        allowed = next((mark for mark in (*marks, *_inner_marks(kind)) if isinstance(mark, Range)), Range())
        unit = "" if not allowed.unit or allowed.unit.upper() == self.called else f" {allowed.unit}"
        numbers = f"{allowed.bounds}{unit}".strip() if allowed.bounds else ""
        if self.default is dataclasses.MISSING:
            last = "required"
        else:
            last = "" if isinstance(self.default, bool) else f"default: {self.written(self.default)}"
        notes = "; ".join(filter(None, (numbers, last)))
        return (f"{self.text} ({notes})" if notes else self.text).replace("%", "%%")

    def written(self, value: Any) -> str:
        """A value as the command line has it."""
        word = next((mark for mark in unwrapped(self.hint)[1] if isinstance(mark, Converter)), None)
        if value is None or value == ():
            return NONE
        if word is not None:
            return word.write(value)
        return " ".join(map(str, value)) if isinstance(value, tuple) else str(value)

    def value(self, words: Sequence[str], flag: str) -> Any:
        """The value in the user's words."""
        kind, marks, optional = unwrapped(self.hint)
        if optional and [word.lower() for word in words] == [NONE]:
            return None
        word = next((mark for mark in marks if isinstance(mark, Converter)), None)
        if word is not None:
            try:
                return taken(self.hint, word.read(words[0]), flag)
            except ValueError as error:
                raise error.at(flag) if isinstance(error, FieldError) else UsageError(f"{flag}: {error}") from None
        is_tuple = typing.get_origin(kind) is tuple
        if self.count == "*" and list(words) == [NONE]:
            return ()
        parts = typing.get_args(kind) if is_tuple else (kind,)
        values = [_plain(parts[0], word) for word in words]
        return taken(self.hint, tuple(values) if is_tuple else values[0], flag)


def _inner_marks(kind: Any) -> tuple[Any, ...]:
    """What is said of the values of a tuple."""
    return unwrapped(typing.get_args(kind)[0])[1] if typing.get_origin(kind) is tuple else ()


def _plain(hint: Any, word: str) -> Any:
    """A word as the number or the choice that it stands for; the word itself where it stands for none."""
    kind = unwrapped(hint)[0]
    if typing.get_origin(kind) is Literal:
        return next((choice for choice in typing.get_args(kind) if str(choice) == word), word)
    if kind in (int, float):
        for number in (int, kind):
            try:
                return number(word)
            except ValueError:
                continue
    return named_path(word) if kind is Path else word


class Parser(argparse.ArgumentParser):
    """A parser whose errors are exceptions, so that they can be told as all others are."""

    def error(self, message: str) -> NoReturn:
        """Raise what argparse would print."""
        raise UsageError(message.removeprefix("argument "))


def parser_of(kind: type, *, program: str, description: str, defaults: Mapping[str, Any] | None = None) -> Parser:
    """The parser of a command's options."""
    width = min(shutil.get_terminal_size().columns, 110)
    options = options_of(kind, defaults)
    positional = [option for option in options if option.how.positional]
    called = [f"{option.called} ..." if option.count == "*" else option.called for option in positional]
    required = [option.default is dataclasses.MISSING for option in positional]
    words = [name if needed else f"[{name}]" for name, needed in zip(called, required, strict=True)]
    parser = Parser(
        prog=program,
        usage=" ".join([program, "[-h] [OPTIONS]", *words]),
        description=_filled(description, width),
        formatter_class=lambda prog: argparse.RawDescriptionHelpFormatter(prog, width=width),
        allow_abbrev=False,
        argument_default=argparse.SUPPRESS,
    )
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
    parser = parser_of(kind, program=program, description=description, defaults=defaults)
    # A space keeps argparse from taking a negative number for a flag.
    spaced = [f" {word}" if _NEGATIVE.fullmatch(word) else word for word in map(_dashed, words)]
    given, rest = parser.parse_known_intermixed_args(spaced)
    if rest:
        flags = [flag for action in parser._actions for flag in action.option_strings]
        unknown = next((word for word in rest if word.startswith("-")), rest[0]).partition("=")[0]
        do = nearest(unknown, flags, f"see {program} --help") if unknown.startswith("-") else "leave it out"
        raise UsageError.of("options", "those of the command", " ".join(rest), do)
    try:
        return _built(kind, options_of(kind, defaults), vars(given))
    except InvalidValueError as error:
        raise UsageError(str(error)) from None


def _dashed(word: str) -> str:
    """A word with dashes in the name of its flag, which may be written with underscores."""
    flag, equals, value = word.partition("=")
    return f"{flag.replace('_', '-')}{equals}{value}" if flag.startswith("--") else word


def options_of(kind: type, defaults: Mapping[str, Any] | None = None) -> list[Option]:
    """The options of a command: those of the class itself first, then those that it shares with other commands."""
    bases = reversed([*enumerate(kind.__mro__)])
    ranks = {name: rank for rank, base in bases for name in inspect.get_annotations(base)}
    values = {
        field.name: field.default if field.default_factory is dataclasses.MISSING else field.default_factory()
        for field in sorted(dataclasses.fields(kind), key=lambda field: ranks[field.name])
    }
    return _options(kind, {**values, **(defaults or {})})


def _options(kind: type, values: Mapping[str, Any], key: str = "", prefix: str = "") -> list[Option]:
    hints, texts = type_hints(kind), field_texts(kind)
    return [
        Option(key=f"{key}{name}", hint=hints[name], default=default, text=texts.get(name, ""), prefix=prefix)
        for name, default in values.items()
    ]


def _add(parser: Parser, group: Any, options: Sequence[Option], width: int) -> None:
    """Add options to a group of a parser, or to itself; those of a dataclass are a group of their own."""
    for option in options:
        if dataclasses.is_dataclass(option.default):
            title = f"{option.key.replace('_', ' ')} options"
            _add(parser, parser.add_argument_group(title, _filled(option.text, width - 2)), option.parts, width)
        elif option.how.positional:
            count = "?" if option.count is None else option.count
            group.add_argument(option.key, nargs=count, metavar=option.called, help=option.help)
        elif isinstance(option.default, bool):
            const = not option.default
            group.add_argument(option.flag, dest=option.key, action="store_const", const=const, help=option.help)
        else:
            called: Any = option.called
            if isinstance(option.count, int) and len(called.split()) == option.count:
                called = tuple(called.split())
            flags = (option.flag, *option.how.aliases)
            group.add_argument(*flags, dest=option.key, nargs=option.count, metavar=called, help=option.help)


def _built(kind: type[_Type], options: Sequence[Option], given: Mapping[str, Any]) -> _Type:
    """A dataclass of what was given, by the keys of options, and of defaults."""
    values: dict[str, Any] = {}
    for option in options:
        words = given.get(option.key)
        if dataclasses.is_dataclass(option.default):
            values[option.name] = _built(type(option.default), option.parts, given)
        elif isinstance(words, bool):
            values[option.name] = words
        elif words not in (None, []):
            texts = [word.removeprefix(" ") for word in ([words] if isinstance(words, str) else words)]
            values[option.name] = option.value(texts, option.flag)
        elif option.default is dataclasses.MISSING:
            raise UsageError.of("arguments" if option.how.positional else option.flag, option.called, "none", "add it")
        else:
            is_empty = option.key in given and not option.how.positional  # the flag of a tuple, and nothing behind it
            values[option.name] = () if is_empty else option.default
    try:
        return kind(**values)
    except FieldError as error:
        flags = {option.name: option.flag for option in options}
        raise error.at(flags.get(error.what, error.what)) from None


@cache
def field_texts(kind: Any) -> dict[str, str]:
    """What each field of a dataclass means: the text below it, or its entry under "Attributes:"."""
    texts: dict[str, str] = {}
    for base in reversed(kind.__mro__):
        if "__dataclass_fields__" in vars(base):
            texts |= _attributes(inspect.getdoc(base) or "") | _below(base.__module__, base.__name__)
    return {name: " ".join(text.split()) for name, text in texts.items()}


def _attributes(doc: str) -> dict[str, str]:
    """The entries under "Attributes:" of a docstring."""
    texts: dict[str, str] = {}
    name, section = "", doc.partition("\nAttributes:\n")[2]
    for line in section.splitlines():
        entry = re.match(r" {4}(\w+): (.*)", line)
        if entry:
            name, texts[entry[1]] = entry[1], entry[2]
        elif line.startswith("     "):
            texts[name] += f" {line.strip()}"
        else:
            break
    return texts


def _below(module: str, kind: str) -> dict[str, str]:
    """The texts below the fields of a dataclass in its source."""
    for node in _source(module).body:
        if isinstance(node, ast.ClassDef) and node.name == kind:
            return {
                field.target.id: text.value.value
                for field, text in zip(node.body, node.body[1:], strict=False)
                if isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name)
                if isinstance(text, ast.Expr) and isinstance(text.value, ast.Constant)
                if isinstance(text.value.value, str)
            }
    return {}


@cache
def _source(module: str) -> ast.Module:
    path = sys.modules[module].__file__
    return ast.parse(Path(path).read_text("utf-8")) if path and os.path.isfile(path) else ast.Module([], [])


def _filled(text: str, width: int) -> str:
    """Paragraphs filled, but for those whose second line is indented, as examples are."""
    paragraphs = re.split(r"\n\s*\n", text)
    return "\n\n".join(part if "\n  " in part else textwrap.fill(" ".join(part.split()), width) for part in paragraphs)
