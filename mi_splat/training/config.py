"""How a splat is trained: the settings of a run as one frozen value; light, for the
command line.
"""

from dataclasses import dataclass, field
from typing import Annotated

from mi_splat.attributes import ATTRIBUTES, Attribute
from mi_splat.errors import InvalidValueError
from mi_splat.fields import (
    Degree,
    Fraction,
    Metavar,
    Share,
    Steps,
    above,
    at_least,
    check,
)
from mi_splat.training.strategies import ClassicConfig, StrategyConfig

Interval = Annotated[int, at_least(0, "steps")]
LearningRate = Annotated[float, at_least(0), Metavar("RATE")]
DecayingRate = Annotated[float, above(0, do="1e-9 is next to nothing"), Metavar("RATE")]


@dataclass(frozen=True, slots=True, kw_only=True)
class FitConfig:
    """How a splat is trained; the defaults are the published recipe, shortened.

    Attributes:
        iterations: Number of steps, with one image each.
        trainable: Attributes to train; only sh with the fixed strategy trains the
            texture of a frozen geometry.
        strategy: How Gaussians are added and removed, and its options. All but the
            fixed one need every attribute trainable.
        coarse_until: Share of the steps that use downscaled images: the first half of
            them at a quarter of the size, the others at half.
        sh_degree: SH degree of the result.
        sh_degree_interval: Interval for increasing the trained SH degree, in steps; 0
            trains all degrees from the start. Default: a thirtieth of the steps, as
            1,000 of 30,000 in 3DGS.
        lambda_dssim: Weight of D-SSIM in the loss; the rest is L1.
        lr_means: Initial learning rate of the means, in units of the scene's extent.
        lr_means_final: Final learning rate of the means, with exponential decay.
        lr_scales: Learning rate of the log-scales.
        lr_rotations: Learning rate of the quaternions.
        lr_opacities: Learning rate of the logit opacities.
        lr_sh: Learning rate of the first SH coefficient.
        lr_sh_divisor: Divisor of that rate for the other SH coefficients; 20 in the
            published recipe.
        lr_sh_final: Final learning rate of SH, with exponential decay. Default: no
            decay.
        eval_interval: Steps between evaluations on the held-out images; 0 evaluates
            only at the end.

    Raises:
        InvalidValueError: A value is of the wrong kind or out of its range, or the
            strategy needs more trainable.
    """

    iterations: Steps = 7000
    trainable: tuple[Attribute, ...] = ATTRIBUTES
    strategy: StrategyConfig = field(default_factory=ClassicConfig)
    coarse_until: Share = 0.0
    sh_degree: Degree = 3
    sh_degree_interval: Interval | None = None
    lambda_dssim: Annotated[Fraction, Metavar("WEIGHT")] = 0.2
    lr_means: DecayingRate = 1.6e-4
    lr_means_final: DecayingRate = 1.6e-6
    lr_scales: LearningRate = 5e-3
    lr_rotations: LearningRate = 1e-3
    lr_opacities: LearningRate = 5e-2
    lr_sh: LearningRate = 2.5e-3
    lr_sh_divisor: Annotated[float, above(0)] = 2.5
    lr_sh_final: DecayingRate | None = None
    eval_interval: Annotated[
        int, at_least(0, "steps", "0 evaluates at the end only")
    ] = 1000

    def __post_init__(self) -> None:
        if not isinstance(self.strategy, StrategyConfig):
            do = "pass for instance ClassicConfig(), or strategy_config(name)"
            raise InvalidValueError.of(
                "strategy", "the options of a strategy", repr(self.strategy), do
            )
        check(self)
        if not self.trainable:
            expected = f"some of {', '.join(ATTRIBUTES)}"
            raise InvalidValueError.of(
                "trainable", expected, self.trainable, "name what may change"
            )
        frozen = [
            name for name in self.strategy.needs_trainable if name not in self.trainable
        ]
        if frozen:
            expected = f"one that does not need {', '.join(frozen)} trainable"
            got = type(self.strategy).__name__
            raise InvalidValueError.of(
                "strategy", expected, got, "use the fixed strategy, or train them"
            )
        if self.lr_sh_final is not None and self.lr_sh == 0:
            expected = "a number > 0, as it decays exponentially"
            raise InvalidValueError.of(
                "lr_sh", expected, self.lr_sh, "1e-9 is next to nothing"
            )

    def coarseness(self, iteration: int) -> int:
        """By how much the images of a step are smaller.

        Args:
            iteration: Steps before it.

        Returns:
            Divisor of both sides: 4, 2 or 1.
        """
        done = iteration / self.iterations
        if done < self.coarse_until / 2:
            return 4
        return 2 if done < self.coarse_until else 1
