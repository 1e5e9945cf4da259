"""The options of each strategy; light, so that a command line can be parsed without
torch.
"""

from dataclasses import dataclass
from typing import Annotated, Any, ClassVar

from mi_splat.attributes import ATTRIBUTES, Attribute
from mi_splat.errors import InvalidValueError
from mi_splat.fields import (
    Checked,
    Fraction,
    Metavar,
    Steps,
    above,
    at_least,
    check_choice,
)
from mi_splat.registry import Registry
from mi_splat.training.strategies.base import FixedStrategy, Strategy

Interval = Annotated[int, at_least(0, "steps")]
Opacity = Annotated[Fraction, Metavar("OPACITY")]
Weight = Annotated[float, at_least(0), Metavar("WEIGHT")]


@dataclass(frozen=True, slots=True, kw_only=True)
class StrategyConfig(Checked):
    """The options that all strategies have; each derives a frozen dataclass with its
    own.

    Fields are the options in Python, the flags of `mi-splat train`, and what a
    checkpoint holds: numbers, strings, booleans, or None.

    Attributes:
        max_gaussians: Maximum number of Gaussians; none for no limit.

    Raises:
        InvalidValueError: A number is not finite, or not whole where it is an int; of
            derived dataclasses, too.
    """

    needs_screen_gradients: ClassVar[bool] = False
    """Whether the renderer has to keep `ScreenGradients`."""
    needs_trainable: ClassVar[tuple[Attribute, ...]] = ATTRIBUTES
    """The attributes that have to be trained."""
    adds_gaussians: ClassVar[bool] = True
    """Whether Gaussians are added, so that `max_gaussians` matters."""

    max_gaussians: (
        Annotated[int, at_least(1, "Gaussians", "leave it out for no limit")] | None
    ) = 100_000

    def build(self) -> Strategy:
        """The strategy with these options; each derived class makes its own."""
        raise NotImplementedError(f"{type(self).__name__}.build")


@dataclass(frozen=True, slots=True, kw_only=True)
class ClassicConfig(StrategyConfig):
    """Clone, split and prune by the gradient of the mean on the screen (Kerbl et al.
    2023, section 5.2).

    Attributes:
        densify_from: First iteration at which Gaussians may be added.
        densify_until: Last iteration at which Gaussians are added or opacities reset.
            Default: half of the iterations, as 15,000 of 30,000 in 3DGS.
        densify_interval: Iterations between densification rounds.
        densify_grad_threshold: Threshold of the mean gradient of the projected centre
            (normalised device coordinates) above which a Gaussian is cloned or split.
        percent_dense: Gaussians larger than this share of the scene's extent are split,
            smaller ones cloned.
        prune_opacity: Gaussians with lower opacity are removed.
        prune_scale: Gaussians larger than this share of the extent are removed once
            opacities have been reset.
        opacity_reset_interval: Iterations between resets of the opacities to at most
            0.01; 0 disables them.
    """

    needs_screen_gradients: ClassVar[bool] = True

    densify_from: Interval = 500
    densify_until: Interval | None = None
    densify_interval: Steps = 100
    densify_grad_threshold: Annotated[float, at_least(0), Metavar("GRADIENT")] = 2e-4
    percent_dense: Annotated[
        float, at_least(0, "shares of the scene's extent"), Metavar("SHARE")
    ] = 0.01
    prune_opacity: Opacity = 0.005
    prune_scale: Annotated[
        float, above(0, "shares of the scene's extent"), Metavar("SHARE")
    ] = 0.1
    opacity_reset_interval: Interval = 3000

    def build(self) -> Strategy:
        """The strategy with these options."""
        from mi_splat.training.strategies.classic import ClassicStrategy

        return ClassicStrategy(self)


@dataclass(frozen=True, slots=True, kw_only=True)
class MCMCConfig(StrategyConfig):
    """Relocation of dead Gaussians, with noise that explores (Kheradmand et al. 2024).

    Attributes:
        densify_from: First iteration at which Gaussians are moved and added.
        densify_until: No more after this one.
        densify_interval: Iterations between densification rounds.
        growth: Share by which their number grows each round until the limit.
        dead_opacity: Opacity up to which a Gaussian is dead.
        noise_lr: Size of the noise on the means, in units of their learning rate.
        opacity_reg: Weight of the mean opacity in the loss.
        scale_reg: Weight of the mean scale in the loss.
    """

    densify_from: Interval = 500
    densify_until: Interval = 25_000
    densify_interval: Steps = 100
    growth: Annotated[float, at_least(0), Metavar("SHARE")] = 0.05
    dead_opacity: Opacity = 0.005
    noise_lr: Annotated[float, at_least(0), Metavar("RATE")] = 5e5
    opacity_reg: Weight = 0.01
    scale_reg: Weight = 0.01

    def build(self) -> Strategy:
        """The strategy with these options."""
        from mi_splat.training.strategies.mcmc import MCMCStrategy

        return MCMCStrategy(self)


@dataclass(frozen=True, slots=True, kw_only=True)
class FixedConfig(StrategyConfig):
    """The number of Gaussians stays as it is, whatever its limit."""

    needs_trainable: ClassVar[tuple[Attribute, ...]] = ()
    adds_gaussians: ClassVar[bool] = False

    def build(self) -> Strategy:
        """The strategy with these options."""
        return FixedStrategy()


STRATEGIES: Registry[type[StrategyConfig]] = Registry(
    "mi_splat.strategies",
    "a class derived from StrategyConfig",
    lambda value: isinstance(value, type) and issubclass(value, StrategyConfig),
    what="strategy",
)
"""The options of each strategy by its name; add yours, so that commands, studies and
checkpoints can name it.
"""
STRATEGIES.add("classic", ClassicConfig)
STRATEGIES.add("mcmc", MCMCConfig)
STRATEGIES.add("fixed", FixedConfig)


def strategy_config(name: str, **options: Any) -> StrategyConfig:
    """The options of the strategy with a name; those that are not given have their
    defaults.
    """
    check_choice("strategy", name, STRATEGIES)
    return STRATEGIES[name](**options)


def strategy_name(config: StrategyConfig) -> str:
    """The name of a strategy's options among `STRATEGIES`."""
    for name, kind in STRATEGIES.items():
        if type(config) is kind:
            return name
    do = (
        "add it to mi_splat.training.strategies.STRATEGIES, so that a checkpoint can"
        " name it"
    )
    raise InvalidValueError.of(
        "strategy", "one of STRATEGIES", type(config).__name__, do
    )
