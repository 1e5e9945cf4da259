"""The settings of the integrators: a `RenderSettings`, and Dr.Jit arrays for
`mi.traverse`.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import mitsuba as mi
import numpy as np

from mi_splat.errors import InvalidValueError
from mi_splat.render.settings import RenderSettings


class IntegratorSettings:
    """The settings of one integrator, and what `mi.traverse` shows of them.

    The plain values count: reading the shown arrays waits for every kernel in flight.
    """

    def __init__(self, usual: RenderSettings, names: Sequence[str], props: Any) -> None:
        self.values, self._names, self.given = usual, names, set[str]()
        self._shown = {name: _array(getattr(usual, name)) for name in names}
        for name in names:
            if name in props:
                self.set(**{name: props[name]})

    def set(self, **values: Any) -> None:
        """Take new values: all, or none if one of them cannot be."""
        kept = {
            name: _plain(name, getattr(self.values, name), value)
            for name, value in values.items()
        }
        self.values = replace(self.values, **kept)
        self.given |= kept.keys()
        self._show(kept)

    def _show(self, names: Any) -> None:
        # In place, as SceneParameters does it: one made before shall show the new
        # value.
        for name in names:
            mi.set_property(self._shown[name], _array(getattr(self.values, name)))

    def traverse(self, callback: Any) -> None:
        """Show every setting to `mi.traverse`."""
        for name, array in self._shown.items():
            callback.put(name, array, mi.ParamFlags.NonDifferentiable)

    def changed(self, keys: Sequence[str]) -> None:
        """Take over what `mi.traverse` was given; a value that cannot be is refused,
        and the old one stays.
        """
        names = [name for name in self._names if name in keys]
        try:
            self.set(**{name: self._shown[name] for name in names})
        except InvalidValueError:
            self._show(names)
            raise

    def __str__(self) -> str:
        return ", ".join(
            f"{name} = {getattr(self.values, name)}" for name in self._names
        )


def _array(value: Any) -> Any:
    """A plain value as an array of the current variant."""
    kind = (
        mi.Bool
        if isinstance(value, bool)
        else mi.Color3f
        if isinstance(value, tuple)
        else mi.Float
    )
    return kind(value)


def _plain(name: str, old: Any, value: Any) -> Any:
    """A value as plain Python has it, of the kind of the old one, from a plain, NumPy
    or Dr.Jit value.
    """
    expected = {
        bool: "true or false",
        float: "a positive distance",
        tuple: "three finite numbers",
    }[type(old)]
    try:
        numbers = [
            float(number) for number in np.ravel(np.array(value, dtype=np.float64))
        ]
    except (TypeError, ValueError):
        raise InvalidValueError.of(
            name, expected, repr(value), "give numbers"
        ) from None
    if isinstance(old, tuple):
        return tuple(numbers * 3 if len(numbers) == 1 else numbers)
    if len(numbers) != 1 or (isinstance(old, bool) and numbers[0] not in (0.0, 1.0)):
        raise InvalidValueError.of(name, expected, value, "give one value")
    return type(old)(numbers[0])


def setting_property(name: str) -> property:
    """Attribute of an integrator, whose `settings` are `IntegratorSettings`, that reads
    and sets one of them.
    """
    return property(
        lambda self: getattr(self.settings.values, name),
        lambda self, value: self.settings.set(**{name: value}),
    )


def common_methods(
    plugin: str,
) -> tuple[Callable[..., None], Callable[..., None], Callable[..., Any]]:
    """`traverse`, `parameters_changed` and `render_forward`, which is refused, of an
    integrator with `settings`.
    """

    def traverse(self: Any, callback: Any) -> None:
        self.settings.traverse(callback)

    def parameters_changed(self: Any, keys: list[str]) -> None:
        self.settings.changed(keys)

    def render_forward(self: Any, *_: Any, **__: Any) -> Any:
        do = "use dr.backward(), or volprim_rf_basic"
        raise InvalidValueError.of(
            plugin, "reverse-mode differentiation", "forward mode", do
        )

    return traverse, parameters_changed, render_forward


def name_integrator(integrator: Any, props: Any) -> None:
    """Give an integrator without an id the usual one; Mitsuba would name it by its
    address.
    """
    if not props.id() or props.id().startswith("_unnamed_"):
        integrator.set_id("integrator")
