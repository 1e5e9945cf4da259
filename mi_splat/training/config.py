"""How a splat is trained: the settings of a run as one frozen value."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from mi_splat.attributes import ATTRIBUTES, Attribute
from mi_splat.errors import InvalidValueError, message
from mi_splat.training.strategies import ClassicConfig, MCMCConfig

StrategyName = Literal["classic", "mcmc", "fixed"]


def densification(
    strategy: StrategyName, *, max_gaussians: int, stop: int = 15_000
) -> ClassicConfig | MCMCConfig | None:
    """Where a recipe adds and removes Gaussians.

    Args:
        strategy: 3DGS's own, relocation, or neither.
        max_gaussians: Largest number of Gaussians.
        stop: Last step at which the classic recipe may add some.
    """
    if strategy == "classic":
        return ClassicConfig(max_gaussians=max_gaussians, densify_until=stop)
    return MCMCConfig(max_gaussians=max_gaussians) if strategy == "mcmc" else None


@dataclass(frozen=True, slots=True, kw_only=True)
class FitConfig:
    """How a splat is trained; the defaults are the published recipe, shortened.

    Attributes:
        iterations: Number of steps; each sees one view.
        trainable: What may change; `("sh",)` trains the texture of a frozen geometry.
        densification: Where Gaussians are added and removed; None keeps their number. Any but None needs means,
            scales, rotations and opacities trainable.
        sh_degree: SH degree of the result.
        sh_degree_interval: Steps between two raises of the degree that is trained; 0 trains all of it from the start.
        lambda_dssim: Weight of D-SSIM in the loss; the rest is L1.
        lr_means: First learning rate of the means, in units of the scene's extent.
        lr_means_final: Last one; between them it decays exponentially.
        lr_scales: Learning rate of the log-scales.
        lr_rotations: Learning rate of the quaternions.
        lr_opacities: Learning rate of the logit opacities.
        lr_sh: Learning rate of the first SH coefficient; the others have a twentieth of it.
        eval_interval: Steps between two looks at the held-out views; 0 looks at the end only.
    """

    iterations: int = 7000
    trainable: tuple[Attribute, ...] = ATTRIBUTES
    densification: ClassicConfig | MCMCConfig | None = field(default_factory=ClassicConfig)
    sh_degree: int = 3
    sh_degree_interval: int = 1000
    lambda_dssim: float = 0.2
    lr_means: float = 1.6e-4
    lr_means_final: float = 1.6e-6
    lr_scales: float = 5e-3
    lr_rotations: float = 1e-3
    lr_opacities: float = 5e-2
    lr_sh: float = 2.5e-3
    eval_interval: int = 1000

    def __post_init__(self) -> None:
        unknown = [name for name in self.trainable if name not in ATTRIBUTES]
        if unknown or not self.trainable:
            raise InvalidValueError(
                message("trainable", f"some of {', '.join(ATTRIBUTES)}", self.trainable, "name what may change")
            )
        if self.densification is not None and set(self.trainable) != set(ATTRIBUTES):
            raise InvalidValueError(
                message("densification", "None where not everything is trained", self.densification, "pass None")
            )
        for name, value, least in (
            ("iterations", self.iterations, 1),
            ("sh_degree_interval", self.sh_degree_interval, 0),
        ):
            if value < least:
                raise InvalidValueError(message(name, f"a number >= {least}", value, "ask for more"))
        if self.sh_degree not in (0, 1, 2, 3):
            raise InvalidValueError(message("sh_degree", "0, 1, 2 or 3", self.sh_degree, "3 is what 3DGS writes"))
