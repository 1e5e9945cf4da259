"""Configurations as canonical JSON: equal ones give the same text, and the text gives the configuration back."""

import dataclasses
import enum
import hashlib
import importlib
import json
import math
from collections.abc import Collection, Mapping
from typing import Any

from mi_splat.errors import InvalidValueError

CLASS = "class"  # key of the name of a class in the JSON of one of its values: module, colon, class
_FLOAT, _NAME = "float", "name"


def canonical(value: Any) -> str:
    """A JSON value as its one text: keys sorted, numbers exact, nothing between."""
    return json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False)


def digest(value: Any) -> str:
    """32 hex digits that stand for a JSON value."""
    return hashlib.sha256(canonical(value).encode()).hexdigest()[:32]


def encoded(value: Any, where: str = "config") -> Any:
    """A configuration as JSON: every field of every frozen dataclass, members of enumerations, tuples as lists."""
    kind = type(value)
    if value is None or kind is str or kind is int or kind is bool:
        return value
    if isinstance(value, float):
        number = float(value)
        return number if math.isfinite(number) else {CLASS: _FLOAT, _NAME: repr(number)}
    if kind is tuple or kind is list:
        return [encoded(item, where) for item in value]
    if is_frozen(value):
        fields = {field.name: encoded(getattr(value, field.name), f"{where}.{field.name}") for field in _fields(kind)}
        return {CLASS: f"{kind.__module__}:{kind.__qualname__}", **fields}
    if isinstance(value, enum.Enum):
        return {CLASS: f"{kind.__module__}:{kind.__qualname__}", _NAME: value.name}
    if isinstance(value, Mapping) and all(type(key) is str and key != CLASS for key in value):
        return {key: encoded(item, f"{where}.{key}") for key, item in value.items()}
    expected = "numbers, texts, tuples, mappings and frozen dataclasses"
    do = "give what it stands for, or make the file that holds it an input"
    raise InvalidValueError.of(where, expected, kind.__name__, do)


def without_modules(value: Any) -> Any:
    """The JSON of a configuration with the names of its classes alone, which stay when a module is moved."""
    if isinstance(value, list):
        return [without_modules(item) for item in value]
    if not isinstance(value, Mapping):
        return value
    return {key: str(item).rpartition(":")[2] if key == CLASS else without_modules(item) for key, item in value.items()}


def is_frozen(value: Any) -> bool:
    """Whether a value is one of a frozen dataclass."""
    parameters = getattr(type(value), "__dataclass_params__", None)
    return parameters is not None and bool(parameters.frozen)


def decoded(value: Any, modules: Collection[str]) -> Any:
    """The configuration that `encoded` made JSON of; lists come back as tuples, missing fields have their defaults."""
    if isinstance(value, list):
        return tuple(decoded(item, modules) for item in value)
    if not isinstance(value, dict):
        return value
    if CLASS not in value:
        return {key: decoded(item, modules) for key, item in value.items()}
    rest = {key: item for key, item in value.items() if key != CLASS}
    if value[CLASS] == _FLOAT:
        return float(rest[_NAME])
    cls = _class(str(value[CLASS]), modules)
    if issubclass(cls, enum.Enum):
        return cls[rest[_NAME]]
    made = {field.name for field in _fields(cls) if field.init}
    unknown = sorted(rest.keys() - {field.name for field in _fields(cls)})
    if unknown:
        raise InvalidValueError.of(str(value[CLASS]), "its fields", ", ".join(unknown), "make the result again")
    return cls(**{key: decoded(item, modules) for key, item in rest.items() if key in made})


def _fields(cls: type) -> tuple[dataclasses.Field[Any], ...]:
    return dataclasses.fields(cls)


def _class(name: str, modules: Collection[str]) -> type:
    module, _, path = name.partition(":")
    cls: Any = importlib.import_module(module) if module in modules else None
    for part in path.split("."):
        cls = getattr(cls, part, None)
    if isinstance(cls, type) and (dataclasses.is_dataclass(cls) or issubclass(cls, enum.Enum)):
        return cls
    expected = "a dataclass or an enumeration of a module that the kind imports"
    raise InvalidValueError.of("config", expected, name, "import it in the kind's module")
