"""The strategies by name: their options and how they are made; light, for a strategy is imported when it is made."""

from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Any, TypeVar

from mi_splat.errors import InvalidValueError, nearest
from mi_splat.training.strategies.base import FixedStrategy, Strategy
from mi_splat.training.strategies.config import ClassicConfig, FixedConfig, MCMCConfig, StrategyConfig

_Config = TypeVar("_Config", bound=StrategyConfig)


@dataclass(frozen=True, slots=True)
class _Entry:
    config: type[StrategyConfig]
    build: Callable[[Any], Strategy]


def _classic(config: ClassicConfig) -> Strategy:
    from mi_splat.training.strategies.classic import ClassicStrategy

    return ClassicStrategy(config)


def _mcmc(config: MCMCConfig) -> Strategy:
    from mi_splat.training.strategies.mcmc import MCMCStrategy

    return MCMCStrategy(config)


_REGISTRY: dict[str, _Entry] = {
    "classic": _Entry(ClassicConfig, _classic),
    "mcmc": _Entry(MCMCConfig, _mcmc),
    "fixed": _Entry(FixedConfig, lambda config: FixedStrategy()),
}


def register_strategy(name: str, config: type[_Config], build: Callable[[_Config], Strategy]) -> None:
    """Make a strategy known by a name: to `fit`, to `mi-splat train --strategy`, to studies, and to checkpoints.

    To use it from a shell, call the command line where it is registered, with `main` of `attacks.cli`:
    `python -c "import mine; main()" train out/car --strategy mine --out out/splat`.
    """
    if name in _REGISTRY and _REGISTRY[name].config is not config:
        raise InvalidValueError.of("strategy", "a name of its own", repr(name), "choose another name")
    _REGISTRY[name] = _Entry(config, build)


def build_strategy(config: StrategyConfig) -> Strategy:
    """The strategy with these options."""
    return _REGISTRY[strategy_name(config)].build(config)


def strategy_names() -> tuple[str, ...]:
    """All names, those of the library first."""
    return tuple(_REGISTRY)


def strategy_config(name: str, **options: Any) -> StrategyConfig:
    """The options of the strategy with a name; those that are not given have their defaults."""
    if name not in _REGISTRY:
        do = nearest(name, _REGISTRY, "choose one of them, or call register_strategy first")
        raise InvalidValueError.of("strategy", " or ".join(_REGISTRY), repr(name), do)
    known = [entry.name for entry in fields(_REGISTRY[name].config)]
    for option in options:
        if option not in known:
            raise InvalidValueError.of(f"option of {name}", " or ".join(known), repr(option), "leave it out")
    return _REGISTRY[name].config(**options)


def strategy_name(config: StrategyConfig) -> str:
    """The name under which a strategy's options are registered."""
    for name, entry in _REGISTRY.items():
        if type(config) is entry.config:
            return name
    do = "call register_strategy first, so that a checkpoint can name it"
    raise InvalidValueError.of("strategy", "a registered one", type(config).__name__, do)
