"""How Gaussians are added, removed and moved while a splat is trained, and how to plug
in a strategy of your own.

`base` has the hooks that the trainer calls, `config` the options of each strategy and
their names. Importing this package is light.
"""

from mi_splat.training.strategies.base import Edit, ScreenGradients, Step, Strategy
from mi_splat.training.strategies.config import (
    STRATEGIES,
    ClassicConfig,
    FixedConfig,
    MCMCConfig,
    StrategyConfig,
    strategy_config,
    strategy_name,
)

__all__ = [
    "STRATEGIES",
    "ClassicConfig",
    "Edit",
    "FixedConfig",
    "MCMCConfig",
    "ScreenGradients",
    "Step",
    "Strategy",
    "StrategyConfig",
    "strategy_config",
    "strategy_name",
]
