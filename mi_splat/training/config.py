"""How a splat is trained: the settings of a run as one frozen value; light, for the command line."""

from __future__ import annotations

from dataclasses import dataclass, field, fields

from mi_splat.attributes import ATTRIBUTES, Attribute
from mi_splat.config_values import check_decay, check_numbers, several
from mi_splat.errors import InvalidValueError, message
from mi_splat.training.strategies import ClassicConfig, StrategyConfig


@dataclass(frozen=True, slots=True, kw_only=True)
class FitConfig:
    """How a splat is trained; the defaults are the published recipe, shortened.

    Attributes:
        iterations: Number of steps; each looks at one picture.
        trainable: What is trained; sh alone with the fixed strategy trains the texture of a frozen geometry.
        strategy: How Gaussians are added and removed, and its options. All but the fixed one need every attribute
            trainable.
        sh_degree: SH degree of the result.
        sh_degree_interval: Steps between two raises of the degree that is trained; 0 trains all of it from the start.
        lambda_dssim: Weight of D-SSIM in the loss; the rest is L1.
        lr_means: First learning rate of the means, in units of the scene's extent.
        lr_means_final: Last one; between them it decays exponentially.
        lr_scales: Learning rate of the log-scales.
        lr_rotations: Learning rate of the quaternions.
        lr_opacities: Learning rate of the logit opacities.
        lr_sh: Learning rate of the first SH coefficient; the others have a twentieth of it.
        lr_sh_final: Last one; between them it decays exponentially. None is as at first.
        masks: Leave out of the loss what is black in the masks of the set, people who walk by for instance.
        random_background: Put another colour behind splat and pictures in every step, so that what is transparent in
            the pictures stays so; the renderer has to give alpha, and pictures without alpha count as opaque.
        eval_interval: Steps between two evaluations on the held-out pictures; 0 evaluates at the end only.

    Raises:
        InvalidValueError: A value is of the wrong kind or out of its range, or the strategy needs more trainable.
    """

    iterations: int = 7000
    trainable: tuple[Attribute, ...] = ATTRIBUTES
    strategy: StrategyConfig = field(default_factory=ClassicConfig)
    sh_degree: int = 3
    sh_degree_interval: int = 1000
    lambda_dssim: float = 0.2
    lr_means: float = 1.6e-4
    lr_means_final: float = 1.6e-6
    lr_scales: float = 5e-3
    lr_rotations: float = 1e-3
    lr_opacities: float = 5e-2
    lr_sh: float = 2.5e-3
    lr_sh_final: float | None = None
    masks: bool = False
    random_background: bool = False
    eval_interval: int = 1000

    def __post_init__(self) -> None:
        object.__setattr__(self, "trainable", several(self.trainable))
        if not isinstance(self.strategy, StrategyConfig):
            do = "pass for instance ClassicConfig(), or strategy_config(name)"
            raise InvalidValueError(message("strategy", "the options of a strategy", repr(self.strategy), do))
        unknown = [name for name in self.trainable if name not in ATTRIBUTES]
        if unknown or not self.trainable:
            raise InvalidValueError(
                message("trainable", f"some of {', '.join(ATTRIBUTES)}", self.trainable, "name what may change")
            )
        frozen = [name for name in self.strategy.needs_trainable if name not in self.trainable]
        if frozen:
            expected = f"one that does not need {', '.join(frozen)} trainable"
            got = type(self.strategy).__name__
            raise InvalidValueError(message("strategy", expected, got, "use the fixed strategy, or train them"))
        rates = {
            field.name: 0
            for field in fields(self)
            if field.name.startswith("lr_") and getattr(self, field.name) is not None
        }
        check_numbers(self, {"iterations": 1, "sh_degree_interval": 0, "eval_interval": 0, **rates})
        check_decay("lr_means", self.lr_means, self.lr_means_final)
        if self.lr_sh_final is not None:
            check_decay("lr_sh", self.lr_sh, self.lr_sh_final)
        if self.sh_degree not in (0, 1, 2, 3):
            raise InvalidValueError(message("sh_degree", "0, 1, 2 or 3", self.sh_degree, "3 is what 3DGS writes"))
