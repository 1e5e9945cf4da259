"""Package attributes that are imported when they are first used, so that importing a package costs nothing."""

import importlib
import sys
from collections.abc import Callable, Mapping


def attach(
    package: str, homes: Mapping[str, tuple[str, ...]]
) -> tuple[Callable[[str], object], Callable[[], list[str]]]:
    """Make `__getattr__` and `__dir__` for a package."""
    home_of = {name: home for home, names in homes.items() for name in names}

    def get(name: str) -> object:
        if name not in home_of:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        value: object = getattr(importlib.import_module(home_of[name]), name)
        setattr(sys.modules[package], name, value)
        return value

    def names() -> list[str]:
        return sorted({*vars(sys.modules[package]), *home_of})

    return get, names


class Previewed:
    """A value that a notebook shows as small pictures and a line of facts, its `repr`.

    What draws them lies above all values, in the module `cards` of the package of the class. It is imported when a
    notebook asks. So it is no part of the code that results depend on.
    """

    __slots__ = ()

    def _repr_html_(self) -> str:
        kind = next(kind for kind in type(self).__mro__ if Previewed in kind.__bases__)
        return str(importlib.import_module(f"{kind.__module__.partition('.')[0]}.cards").html(self))
