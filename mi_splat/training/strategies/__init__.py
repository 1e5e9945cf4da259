"""How Gaussians are added, removed and moved while a splat is trained, and how to plug in a strategy of your own.

`base` has the hooks that the trainer calls, `config` the options of each strategy, `registry` their names.
Importing this package is light.
"""

from mi_splat.training.strategies.base import Edit, ScreenGradients, Step, Strategy
from mi_splat.training.strategies.config import ClassicConfig, FixedConfig, MCMCConfig, StrategyConfig
from mi_splat.training.strategies.registry import (
    build_strategy,
    register_strategy,
    strategy_config,
    strategy_name,
    strategy_names,
)

__all__ = [
    "ClassicConfig",
    "Edit",
    "FixedConfig",
    "MCMCConfig",
    "ScreenGradients",
    "Step",
    "Strategy",
    "StrategyConfig",
    "build_strategy",
    "register_strategy",
    "strategy_config",
    "strategy_name",
    "strategy_names",
]
