"""The settings of the integrators: plain values from whatever a user gives, and Dr.Jit arrays for `mi.traverse`."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import mitsuba as mi
import numpy as np

from mi_splat.errors import InvalidValueError
from mi_splat.rasterization.settings import checked_background, checked_near

_DISTANCE, _COLOUR, _SWITCH = "a positive distance", "three finite numbers", "true or false"


@dataclass(frozen=True, slots=True)
class Setting:
    """One parameter of the integrator.

    Attributes:
        default: Its value where none is given.
        checked: (any value) -> its plain value; raises InvalidValueError if it cannot be one.
        array: (plain value) -> Dr.Jit array of the current variant.
    """

    default: Any
    checked: Callable[[Any], Any]
    array: Callable[[Any], Any]


def _numbers(name: str, expected: str, value: Any) -> list[float]:
    """All numbers in a plain, NumPy or Dr.Jit value."""
    try:
        array = np.array(value, dtype=np.float64)
    except (TypeError, ValueError):
        raise InvalidValueError.of(name, expected, repr(value), "give numbers") from None
    return [float(v) for v in np.ravel(array)]


def _near(value: Any) -> float:
    numbers = _numbers("near", _DISTANCE, value)
    if len(numbers) != 1:
        raise InvalidValueError.of("near", _DISTANCE, numbers, "give one number")
    return checked_near(numbers[0])


def _background(value: Any) -> tuple[float, float, float]:
    numbers = _numbers("background", _COLOUR, value)
    return checked_background(numbers * 3 if len(numbers) == 1 else numbers)


def _switch(name: str, value: Any) -> bool:
    numbers = _numbers(name, _SWITCH, value)
    if len(numbers) != 1 or numbers[0] not in (0.0, 1.0):
        raise InvalidValueError.of(name, _SWITCH, value, "give a boolean")
    return bool(numbers[0])


TILE_SETTINGS = {
    "background": Setting((0.0, 0.0, 0.0), _background, lambda value: mi.Color3f(value)),
    "near": Setting(0.2, _near, lambda value: mi.Float(value)),
    "alpha": Setting(False, lambda value: _switch("alpha", value), lambda value: mi.Bool(value)),
    "linear": Setting(False, lambda value: _switch("linear", value), lambda value: mi.Bool(value)),
    "antialiased": Setting(False, lambda value: _switch("antialiased", value), lambda value: mi.Bool(value)),
}
"""Those of `splat_tile` by name; the table in `tile` says what each means."""

RAY_SETTINGS = {
    "background": TILE_SETTINGS["background"],
    "alpha": TILE_SETTINGS["alpha"],
    "linear": Setting(True, lambda value: _switch("linear", value), lambda value: mi.Bool(value)),
    "colour_to_mean": Setting(False, lambda value: _switch("colour_to_mean", value), lambda value: mi.Bool(value)),
}
"""Those of `splat_ray` by name; the table in `ray` says what each means."""


class SettingValues:
    """The settings of one integrator: plain values, and what `mi.traverse` shows of them.

    The plain values count: reading the shown arrays waits for every kernel in flight.

    Args:
        settings: By name.
        props: Mitsuba's properties; those that are given are taken.

    Raises:
        InvalidValueError: A value cannot be one.
    """

    def __init__(self, settings: dict[str, Setting], props: Any) -> None:
        self._settings = settings
        self.values = {name: setting.default for name, setting in settings.items()}
        self._shown = {name: setting.array(setting.default) for name, setting in settings.items()}
        self.given: set[str] = set()
        for name in settings:
            if name in props:
                self.set(name, props[name])

    def set(self, name: str, value: Any) -> None:
        """Take a new value for a setting."""
        self.values[name] = self._settings[name].checked(value)
        self.given.add(name)
        self._show(name)

    def _show(self, name: str) -> None:
        # In place, as SceneParameters does it: one made before shall show the new value.
        mi.set_property(self._shown[name], self._settings[name].array(self.values[name]))

    def traverse(self, callback: Any) -> None:
        """Show every setting to `mi.traverse`."""
        for name, array in self._shown.items():
            callback.put(name, array, mi.ParamFlags.NonDifferentiable)

    def changed(self, keys: list[str]) -> None:
        """Take over what `mi.traverse` was given; a value that cannot be is refused, and the old one stays."""
        names = [name for name in self._settings if name in keys]
        try:
            values = {name: self._settings[name].checked(self._shown[name]) for name in names}
        except InvalidValueError:
            for name in names:
                self._show(name)
            raise
        for name, value in values.items():
            self.set(name, value)

    def __str__(self) -> str:
        return ", ".join(f"{name} = {value}" for name, value in self.values.items())


def setting_property(name: str) -> property:
    """Attribute of an integrator, whose `settings` are `SettingValues`, that reads and sets one of them."""
    return property(lambda self: self.settings.values[name], lambda self, value: self.settings.set(name, value))


def common_methods(plugin: str) -> tuple[Callable[..., None], Callable[..., None], Callable[..., Any]]:
    """`traverse`, `parameters_changed` and `render_forward` of an integrator, whose `settings` are `SettingValues`.

    There is no forward mode: `render_forward` raises InvalidValueError, whatever it is given.
    """

    def traverse(self: Any, callback: Any) -> None:
        self.settings.traverse(callback)

    def parameters_changed(self: Any, keys: list[str]) -> None:
        self.settings.changed(keys)

    def render_forward(self: Any, *_: Any, **__: Any) -> Any:
        do = "use dr.backward(), or volprim_rf_basic"
        raise InvalidValueError.of(plugin, "reverse-mode differentiation", "forward mode", do)

    return traverse, parameters_changed, render_forward


DEFAULT_ID = "integrator"
"""Id of an integrator without one, as in the usual dict; Mitsuba would name it by its address."""


def name_integrator(integrator: Any, props: Any) -> None:
    """Give an integrator without an id the usual one."""
    if not props.id() or props.id().startswith("_unnamed_"):
        integrator.set_id(DEFAULT_ID)
