"""What a study says of layers: how they are made, and how the finished file is trained then."""

from dataclasses import dataclass, field, replace
from typing import Annotated

from mi_splat.attributes import ATTRIBUTES
from mi_splat.errors import InvalidValueError
from mi_splat.fields import Degree, PositiveFraction, Range, Steps, above, at_least, check
from mi_splat.training.config import FitConfig
from mi_splat.training.strategies import ClassicConfig, FixedConfig

_WIDTH = Range(low=0, high=90, open_high=True, unit="degrees")
_REFINE_FROM = 100
"""Step from which Gaussians are added to layers, which begin as a splat that is trained already."""


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
    """

    degree: Degree = 3
    gap: Annotated[float | tuple[float, ...], _WIDTH] = 5.0
    band: Annotated[float | tuple[float, ...], _WIDTH] = 0.0
    shift: Annotated[float, Range(low=-90, high=90, open_low=True, open_high=True, unit="degrees")] = 0.0
    apart: bool = False
    weight: Annotated[float, above(0)] = 1.0
    lowest: float = -100.0
    black: Annotated[float, Range(high=0)] = 0.0
    keep: PositiveFraction = 0.995
    inset: Annotated[float, at_least(0, "world units")] = 1e-3

    def __post_init__(self) -> None:
        check(self)
        if not self.lowest < self.black:
            raise InvalidValueError.of("lowest", f"less than black, {self.black:g}", self.lowest, "lower the first")

    def gaps(self, triggers: int) -> tuple[float, ...]:
        """The gap of each of so many triggers."""
        return _for_each("gap", self.gap, triggers, "trigger")

    def bands(self, looks: int) -> tuple[float, ...]:
        """The band of each of so many looks."""
        return _for_each("band", self.band, looks, "look")


def _for_each(name: str, given: float | tuple[float, ...], count: int, what: str) -> tuple[float, ...]:
    """One number for each of `count`, of what is given for all or for each."""
    numbers = given if isinstance(given, tuple) else (given,) * count
    if len(numbers) != count:
        expected = f"one number for all, or {count}, one for each {what}"
        raise InvalidValueError.of(name, expected, f"{len(numbers)} numbers", "give as many as there are")
    return numbers


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
    """

    attacks: tuple[str, ...]
    making: LayerConfig = field(default_factory=LayerConfig)
    margin: Annotated[float, at_least(0, "metres")] = 0.05
    surroundings: bool = False
    geometry: bool = False
    max_gaussians: Annotated[int, at_least(1)] = 100_000
    clearance: Annotated[float, Range(unit="metres")] = 0.0
    iterations: Steps = 3000
    lr_sh: Annotated[float, above(0)] = 0.04
    lr_sh_final: Annotated[float, above(0)] = 0.004

    def __post_init__(self) -> None:
        check(self)
        count = len(set(self.attacks))
        self.making.gaps(count)
        self.making.bands(1 + count)


def layered_fit_config(layers: LayersConfig) -> FitConfig:
    """How layers are trained: their colours alone, or everything."""
    colours = FitConfig(
        iterations=layers.iterations,
        trainable=("sh",),
        strategy=FixedConfig(),
        sh_degree=layers.making.degree,
        sh_degree_interval=0,
        lr_sh=layers.lr_sh,
        lr_sh_final=layers.lr_sh_final,
        eval_interval=0,
    )
    if not layers.geometry:
        return colours
    strategy = ClassicConfig(
        max_gaussians=layers.max_gaussians,
        densify_from=_REFINE_FROM,
        densify_until=layers.iterations * 2 // 3,
        opacity_reset_interval=0,
    )
    return replace(colours, trainable=ATTRIBUTES, strategy=strategy)
