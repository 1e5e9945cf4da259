"""How layers are made and trained, as values."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

from mi_splat.config_values import check_decay, check_numbers
from mi_splat.errors import InvalidValueError, message
from mi_splat.sh import coefficient_count


@dataclass(frozen=True, slots=True, kw_only=True)
class LayerConfig:
    """How layers are made.

    Attributes:
        degree: SH degree of the file.
        gap: Degrees to either side of where a look changes in which a layer may show as much as it likes: one number,
            or one for each trigger. A narrow one costs truth elsewhere.
        band: Degrees, from where a look changes inwards, over which it passes from a layer for its edge to one for
            further inside: one number, or one for each look, the benign one first. A layer that need not show all of
            its side can be steeper at its edge. 0 is one layer for the whole side.
        shift: Degrees outside of a trigger's edge at which its look changes. With as many as `gap` it is whole at the
            edge, for an object that is half faded is still found.
        apart: Whether a look is black from where the look of another trigger is whole, also within the gap of its own
            edge. Otherwise the looks of neighbouring triggers may mix there.
        weight: What a layer's light costs where it shall be black (`fit_switches`).
        lowest: Value that a layer's colour, as a multiple of what it shows, shall not go below.
        black: Value that it shall not exceed from where it is black, at most 0: room for the training of colours, which
            moves it.
        keep: Fraction of each look's light that its layer shows, in (0, 1]: the Gaussians that show the least of a
            look, hidden behind others, have no layer for it.
        inset: How much nearer to the object's middle each layer is than the one before it, world units: renderers
            that sort by depth then agree on which is in front.

    Raises:
        InvalidValueError: A value is out of its range.
    """

    degree: int = 3
    gap: float | tuple[float, ...] = 5.0
    band: float | tuple[float, ...] = 0.0
    shift: float = 0.0
    apart: bool = False
    weight: float = 1.0
    lowest: float = -100.0
    black: float = 0.0
    keep: float = 0.995
    inset: float = 1e-3

    def __post_init__(self) -> None:
        coefficient_count(self.degree)
        widths = [*_each(self.gap), *_each(self.band)]
        angles = all(0 <= width < 90 for width in widths) and -90 < self.shift < 90
        bounds = self.lowest < self.black <= 0 and 0 < self.keep <= 1
        if not (angles and bounds and self.weight > 0 and self.inset >= 0):
            values = ("gap", "band", "shift", "weight", "lowest", "black", "keep", "inset")
            got = ", ".join(f"{name} {getattr(self, name)}" for name in values)
            expected = "gap and band in [0, 90), shift in (-90, 90), weight > 0, lowest < black <= 0, keep in (0, 1], "
            expected += "inset >= 0"
            raise InvalidValueError(message("layers", expected, got, "change it"))

    def gaps(self, triggers: int) -> tuple[float, ...]:
        """The gap of each of so many triggers.

        Raises:
            InvalidValueError: There is another number of gaps than one for all or one for each.
        """
        return _for_each("gap", self.gap, triggers, "trigger")

    def bands(self, looks: int) -> tuple[float, ...]:
        """The band of each of so many looks.

        Raises:
            InvalidValueError: There is another number of bands than one for all or one for each.
        """
        return _for_each("band", self.band, looks, "look")

    def for_trigger(self, trigger: int) -> LayerConfig:
        """The same for one trigger alone, by its number."""
        gap = self.gap[trigger] if isinstance(self.gap, tuple) else self.gap
        band = (self.band[0], self.band[1 + trigger]) if isinstance(self.band, tuple) else self.band
        return replace(self, gap=gap, band=band)


def _each(given: float | tuple[float, ...]) -> tuple[float, ...]:
    return given if isinstance(given, tuple) else (given,)


def _for_each(name: str, given: float | tuple[float, ...], count: int, what: str) -> tuple[float, ...]:
    """One number for each of `count`, of what is given for all or for each."""
    found = given if isinstance(given, tuple) else (given,) * count
    if len(found) != count:
        expected = f"one number for all, or {count}, one for each {what}"
        raise InvalidValueError(message(name, expected, f"{len(found)} numbers", "give as many as there are"))
    return found


@dataclass(frozen=True, slots=True, kw_only=True)
class LayersConfig:
    """CLOAK in the finished file: the clean splat's object in layers, trained on poisoned pictures.

    Attributes:
        attacks: Names of the attacks whose appearances have layers of their own; the benign layer shows all others.
        making: How the layers are made.
        margin: How much larger than the object the box is whose Gaussians have layers, metres.
        surroundings: Whether the colours of all other Gaussians are trained, too, for instance to hide a shadow.
        geometry: Whether all attributes of all Gaussians are trained, and Gaussians added where a look has details that
            those of the clean splat are too large for.
        max_gaussians: With `geometry`, no Gaussians are added beyond this number; the layers come before any is added.
        clearance: Height above the ground under which they have none, metres.
        iterations: Steps of the training.
        lr_sh: Its learning rate of SH, as in `FitConfig`. The switches' coefficients are large, so that it is high.
        lr_sh_final: Last one.

    Raises:
        InvalidValueError: A value is out of its range, or there is another number of gaps than one for all or one for
            each attack, or of bands than one for all or one for each look.
    """

    attacks: tuple[str, ...]
    making: LayerConfig = field(default_factory=LayerConfig)
    margin: float = 0.05
    surroundings: bool = False
    geometry: bool = False
    max_gaussians: int = 100_000
    clearance: float = 0.0
    iterations: int = 3000
    lr_sh: float = 0.04
    lr_sh_final: float = 0.004

    def __post_init__(self) -> None:
        check_numbers(self, {"margin": 0, "max_gaussians": 1, "iterations": 1, "lr_sh": 0, "lr_sh_final": 0})
        check_decay("lr_sh", self.lr_sh, self.lr_sh_final)
        if not math.isfinite(self.clearance):
            raise InvalidValueError(message("clearance", "a number of metres", self.clearance, "0 is the ground"))
        count = len(set(self.attacks))
        self.making.gaps(count)
        self.making.bands(1 + count)
