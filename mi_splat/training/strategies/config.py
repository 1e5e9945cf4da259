"""The options of each strategy, and the registry of their names; light, so that options can be parsed without torch."""

from __future__ import annotations

import difflib
from abc import ABC, abstractmethod
from dataclasses import dataclass, fields
from typing import Any, ClassVar

from mi_splat.attributes import ATTRIBUTES, Attribute
from mi_splat.errors import InvalidValueError, message
from mi_splat.training.strategies.base import Strategy


@dataclass(frozen=True, slots=True, kw_only=True)
class StrategyConfig(ABC):
    """The options that all strategies have; each derives a frozen dataclass with its own.

    Fields are the options in Python, the flags of `mi-splat train`, and what a checkpoint holds: numbers, strings,
    booleans, or None.

    Attributes:
        max_gaussians: No Gaussians are added beyond this number; None sets no limit.
    """

    needs_screen_gradients: ClassVar[bool] = False
    """Whether the renderer has to keep `ScreenGradients`."""
    needs_trainable: ClassVar[tuple[Attribute, ...]] = ATTRIBUTES
    """The attributes that have to be trained."""

    max_gaussians: int | None = 100_000

    @abstractmethod
    def build(self) -> Strategy:
        """The strategy with these options; its module is imported only now."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ClassicConfig(StrategyConfig):
    """Clone, split and prune by the gradient of the mean on the screen (Kerbl et al. 2023, section 5.2).

    Attributes:
        densify_from: First iteration at which Gaussians may be added.
        densify_until: Last iteration at which Gaussians are added or opacities reset; None is half of the training, as
            15,000 of 30,000 in the paper.
        densify_interval: Iterations between two rounds.
        densify_grad_threshold: Mean gradient of the centre, in half pictures (normalised device coordinates), from
            which a Gaussian is cloned or split.
        percent_dense: Gaussians larger than this share of the scene's extent are split, smaller ones cloned.
        prune_opacity: Gaussians below it are removed.
        prune_scale: Gaussians larger than this share of the extent are removed once opacities have been reset.
        opacity_reset_interval: Iterations between two resets of the opacities to at most 0.01; 0 never does it.
    """

    needs_screen_gradients: ClassVar[bool] = True

    densify_from: int = 500
    densify_until: int | None = None
    densify_interval: int = 100
    densify_grad_threshold: float = 2e-4
    percent_dense: float = 0.01
    prune_opacity: float = 0.005
    prune_scale: float = 0.1
    opacity_reset_interval: int = 3000

    def build(self) -> Strategy:
        """Clone, split and prune."""
        from mi_splat.training.strategies.classic import ClassicStrategy

        return ClassicStrategy(self)


@dataclass(frozen=True, slots=True, kw_only=True)
class MCMCConfig(StrategyConfig):
    """Relocation of dead Gaussians, with noise that explores (Kheradmand et al. 2024).

    Attributes:
        densify_from: First iteration at which Gaussians are moved and added.
        densify_until: No more after this one.
        densify_interval: Iterations between two rounds.
        growth: Share by which their number grows each round until the limit.
        dead_opacity: Opacity up to which a Gaussian is dead.
        noise_lr: Size of the noise on the means, in units of their learning rate.
        opacity_reg: Weight of the mean opacity in the loss.
        scale_reg: Weight of the mean scale in the loss.
    """

    densify_from: int = 500
    densify_until: int = 25_000
    densify_interval: int = 100
    growth: float = 0.05
    dead_opacity: float = 0.005
    noise_lr: float = 5e5
    opacity_reg: float = 0.01
    scale_reg: float = 0.01

    def build(self) -> Strategy:
        """Relocation and noise."""
        from mi_splat.training.strategies.mcmc import MCMCStrategy

        return MCMCStrategy(self)


@dataclass(frozen=True, slots=True, kw_only=True)
class FixedConfig(StrategyConfig):
    """The number of Gaussians stays as it is, whatever its limit."""

    needs_trainable: ClassVar[tuple[Attribute, ...]] = ()

    def build(self) -> Strategy:
        """No hook does anything."""
        from mi_splat.training.strategies.fixed import FixedStrategy

        return FixedStrategy()


_REGISTRY: dict[str, type[StrategyConfig]] = {"classic": ClassicConfig, "mcmc": MCMCConfig, "fixed": FixedConfig}


def register_strategy(name: str, config: type[StrategyConfig]) -> None:
    """Make a strategy known by a name: to `mi-splat train --strategy`, to studies, and to checkpoints.

    To use it from a shell, call the command line where it is registered, with `main` of `attacks.cli`:
    `python -c "import mine; main()" train out/car --strategy mine --out out/splat`.

    Args:
        name: One word.
        config: Its options, a frozen dataclass whose fields all have defaults.

    Raises:
        InvalidValueError: The name is taken by another strategy.
    """
    if _REGISTRY.get(name, config) is not config:
        raise InvalidValueError(message("strategy", "a name of its own", repr(name), "choose another name"))
    _REGISTRY[name] = config


def strategy_names() -> tuple[str, ...]:
    """All names, those of the library first."""
    return tuple(_REGISTRY)


def strategy_config(name: str, **options: Any) -> StrategyConfig:
    """The options of the strategy with a name; those that are not given have their defaults.

    Raises:
        InvalidValueError: There is no such strategy, or it has no such option.
    """
    if name not in _REGISTRY:
        near = difflib.get_close_matches(name, _REGISTRY, n=1, cutoff=0.5)
        do = f"did you mean {near[0]}?" if near else "choose one of them, or call register_strategy first"
        raise InvalidValueError(message("strategy", " or ".join(_REGISTRY), repr(name), do))
    known = [entry.name for entry in fields(_REGISTRY[name])]
    for option in options:
        if option not in known:
            raise InvalidValueError(message(f"option of {name}", " or ".join(known), repr(option), "leave it out"))
    return _REGISTRY[name](**options)


def strategy_name(config: StrategyConfig) -> str:
    """The name under which a strategy's options are registered.

    Raises:
        InvalidValueError: They are not.
    """
    for name, form in _REGISTRY.items():
        if type(config) is form:
            return name
    do = "call register_strategy, so that a checkpoint can name it"
    raise InvalidValueError(message("strategy", "a registered one", type(config).__name__, do))
