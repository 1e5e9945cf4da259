"""The options of a command from the words that the user typed: tyro, with ranges checked and help that can be read."""

from __future__ import annotations

import argparse
import dataclasses
import importlib
import inspect
import types
import warnings
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Annotated, Any, Union, get_args, get_origin

import tyro
from tyro.conf import FlagCreatePairsOff, Positional
from tyro.constructors import (
    ConstructorRegistry,
    PrimitiveConstructorSpec,
    PrimitiveTypeInfo,
    StructConstructorSpec,
    StructFieldSpec,
    StructTypeInfo,
)

from attacks.cli.examples import ALIASES, EXAMPLES, SEE_ALSO
from attacks.cli.metavars import metavar
from attacks.cli.ranges import ALL_RANGES
from attacks.cli.usage_errors import in_one_line
from mi_splat.cli.console import PROGRAM
from mi_splat.cli.ranges import UsageError, check_range, check_ranges, numbers_of
from mi_splat.cli.values import as_one_word
from mi_splat.errors import InvalidValueError

if TYPE_CHECKING:
    from attacks.cli import Command

_NONE = "none"
_REGISTRY = ConstructorRegistry()
_ASKED: list[Any] = []
"""The dataclass whose fields are being asked for, if any."""


def parse(name: str, command: Command, words: Sequence[str]) -> object:
    """The options of a command as its frozen dataclass; ends the process for --help.

    Args:
        name: Of the command.
        command: Where its options are.
        words: What the user typed after its name.

    Raises:
        UsageError: The words are no options of the command, or a number is out of its range.
    """
    given = as_one_word([_canonical(word, ALIASES.get(name, {})) for word in words])
    with in_one_line():
        kind, told = _told(name, command, words)
        options = tyro.cli(kind, args=given, description=description(name, kind), **told)
    check_ranges(options, ALL_RANGES)
    return options


def argument_parser(name: str, command: Command) -> argparse.ArgumentParser:
    """The options of a command as a parser of the standard library, from which documentation can be written.

    Args:
        name: Of the command.
        command: Where its options are.
    """
    kind, told = _told(name, command, ())
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # tyro offers nothing else that knows the whole help
        parser: Any = tyro.extras.get_parser(kind, description=inspect.getdoc(kind), **told)
    found: argparse.ArgumentParser = parser
    return found


def _told(name: str, command: Command, words: Sequence[str]) -> tuple[type, dict[str, Any]]:
    """The dataclass of a command's options, and what tyro is told of it.

    Args:
        name: Of the command.
        command: Where its options are.
        words: What the user typed after its name.
    """
    module, program = importlib.import_module(f"{command.package}.{command.options_module}"), f"{PROGRAM} {name}"
    default = {"default": getattr(module, command.defaults)(words, program=program)} if command.defaults else {}
    told = {"prog": program, "config": (FlagCreatePairsOff,), "registry": _REGISTRY, **default}
    return getattr(module, command.options), told


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


@_REGISTRY.struct_rule
def _with_metavars(info: StructTypeInfo) -> StructConstructorSpec | None:
    """Options whose values are called by what they mean (`attacks.cli.metavars`)."""
    if info.type in _ASKED:
        return None  # we are asking tyro's own rule, below
    _ASKED.append(info.type)
    try:
        spec = ConstructorRegistry.get_struct_spec(info)
    finally:
        _ASKED.pop()
    if not isinstance(spec, StructConstructorSpec):
        return None
    owner = getattr(info.type, "__name__", "")
    fields = [dataclasses.replace(field, type=_with_metavar(owner, field)) for field in spec.fields]
    return dataclasses.replace(spec, fields=tuple(fields), instantiate=_checked(spec.instantiate))


def _checked(build: Callable[..., Any]) -> Callable[..., Any]:
    """What makes options of words, but what it refuses becomes one line, which names the flag where its range does."""

    def made(*args: Any, **values: Any) -> Any:
        try:
            return build(*args, **values)
        except InvalidValueError as error:
            for name, value in values.items():
                for number in numbers_of(value):
                    check_range(name, number, ALL_RANGES)
            raise UsageError(str(error)) from None

    return made


def _with_metavar(owner: str, field: StructFieldSpec) -> Any:
    """The type of an option with what its values are called, unless they are choices, options, or have a name.

    Args:
        owner: Name of the dataclass that has the option.
        field: The option.
    """
    marks = getattr(field.type, "__metadata__", ())
    spec = ConstructorRegistry.get_primitive_spec(PrimitiveTypeInfo.make(field.type, set()))
    named = any(getattr(mark, "metavar", None) for mark in marks)
    if named or not isinstance(spec, PrimitiveConstructorSpec) or spec.choices is not None:
        return field.type
    found = metavar(owner, field.name, spec.metavar)
    if found == spec.metavar:
        return field.type
    may_lack = not any(field.default is missing for missing in (tyro.MISSING, tyro.MISSING_NONPROP))
    if may_lack and set(marks) & set(getattr(Positional[str], "__metadata__", ())):
        found = f"[{found}]"  # as tyro has it where a word may be left out
    return Annotated[field.type, tyro.conf.arg(metavar=found)]


@_REGISTRY.primitive_rule
def _optional(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec[Any] | None:
    """`X | None` is asked for as X, and "none" stands for None; tyro would write `{None}|X`."""
    inner = [kind for kind in get_args(info.type) if kind is not type(None)]
    is_union = get_origin(info.type) in (Union, types.UnionType)
    if not is_union or len(inner) != 1 or len(inner) == len(get_args(info.type)):
        return None
    spec = ConstructorRegistry.get_primitive_spec(PrimitiveTypeInfo.make(inner[0], info.markers))
    if not isinstance(spec, PrimitiveConstructorSpec):
        return None
    return dataclasses.replace(
        spec,
        choices=None if spec.choices is None else (*spec.choices, _NONE),
        instance_from_str=lambda words: (
            None if [w.lower() for w in words] == [_NONE] else spec.instance_from_str(words)
        ),
        is_instance=lambda value: value is None or spec.is_instance(value),
        str_from_instance=lambda value: [_NONE] if value is None else spec.str_from_instance(value),
    )


@_REGISTRY.primitive_rule
def _any_number(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec[Any] | None:
    """`tuple[X, ...]` without a value has the default "none"; tyro would write nothing."""
    if get_origin(info.type) is not tuple or get_args(info.type)[1:] != (Ellipsis,):
        return None
    spec = ConstructorRegistry.get_primitive_spec(PrimitiveTypeInfo.make(get_args(info.type)[0], info.markers))
    if not isinstance(spec, PrimitiveConstructorSpec) or spec.nargs != 1:
        return None
    return PrimitiveConstructorSpec(
        nargs="*",
        metavar=f"{spec.metavar} ..." if Positional in info.markers else f"[{spec.metavar} ...]",
        instance_from_str=lambda words: tuple(spec.instance_from_str([word]) for word in words),
        is_instance=lambda values: isinstance(values, tuple) and all(map(spec.is_instance, values)),
        str_from_instance=lambda values: [spec.str_from_instance(value)[0] for value in values] or [_NONE],
        choices=spec.choices,
    )
