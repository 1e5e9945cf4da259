"""Budgets: how far each parameter of an attack may move, and in which norm."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Generator, Tensor

from attacks.optimisers import NORM_NAMES, NormName
from attacks.search.parameters import Parameters
from mi_splat.errors import InvalidValueError, MiSplatError
from mi_splat.fields import at_least, check_choice, checked_number

# Budgets: how far each attribute of the attacked Gaussians may move, and in which norm.
#
# A perturbation lives in the space of the splat file: SH coefficients, means in world
# units, log-scales, quaternions before normalisation, logit opacities. A norm measures
# a perturbation, shrinks it into the ball, gives the steepest direction, and draws from
# the ball; everything else is the same for all norms.

_SLACK = 1e-12
"""Projection aims this much inside, relative to the radius: float64 rounding of the
norm cannot leave the ball.
"""


class BudgetError(MiSplatError):
    """An attack left its budget: a bug in the attack, never the user's fault."""


def _normal(like: Tensor, generator: Generator) -> Tensor:
    # Drawn on the CPU, so that a seed means the same noise on every device.
    return torch.randn(like.shape, generator=generator, dtype=torch.float64).to(
        like.device
    )


def _even(shape: torch.Size, generator: Generator, like: Tensor) -> Tensor:
    draw: Tensor = torch.rand(shape, generator=generator, dtype=torch.float64)
    return draw.to(like.device)


def _unit(delta: Tensor, size: Tensor) -> Tensor:
    return torch.where(size > 0, delta / torch.where(size > 0, size, 1.0), 0.0)


class Linf:
    """The largest change of any one coefficient."""

    def measure(self, delta: Tensor) -> float:
        """Size of the perturbation, compared with the radius: the largest absolute
        value.
        """
        if delta.numel():
            return float(delta.abs().max())
        return 0.0

    def shrink(self, delta: Tensor, radius: float) -> Tensor:
        """The nearest perturbation in the ball; no element grows or changes sign."""
        return delta.clamp(-radius, radius)

    def steepest(self, gradient: Tensor) -> Tensor:
        """Direction of steepest ascent of size 1; zero where the gradient is zero."""
        return gradient.sign()

    def uniform(self, like: Tensor, radius: float, generator: Generator) -> Tensor:
        """A draw from the uniform distribution on the ball."""
        return (2 * _even(like.shape, generator, like) - 1) * radius

    def noise(self, delta: Tensor, generator: Generator) -> Tensor:
        """Random noise of exactly the size of `delta`, the control that an attack has
        to beat: signs at full size.
        """
        return _normal(delta, generator).sign() * self.measure(delta)


class L2:
    """One Euclidean ball over the attribute of the whole object: the PGD of the paper's
    text.
    """

    def sizes(self, delta: Tensor) -> Tensor:
        """Euclidean norm of all that shares a ball, shaped to broadcast against
        `delta`.
        """
        size: Tensor = delta.norm()
        return size

    def measure(self, delta: Tensor) -> float:
        """Size of the perturbation: that of the fullest ball."""
        if delta.numel():
            return float(self.sizes(delta).max())
        return 0.0

    def shrink(self, delta: Tensor, radius: float) -> Tensor:
        """Scale down what is too long."""
        sizes = self.sizes(delta)
        return torch.where(
            sizes > radius, delta * (radius / sizes.clamp(min=1e-300)), delta
        )

    def steepest(self, gradient: Tensor) -> Tensor:
        """The gradient over its norm."""
        if not gradient.numel():
            return gradient
        # The two-step scaling keeps gradients of 1e-30 from vanishing when they are
        # squared.
        scaled = _unit(gradient, gradient.abs().amax())
        return _unit(scaled, self.sizes(scaled))

    def uniform(self, like: Tensor, radius: float, generator: Generator) -> Tensor:
        """A direction from the sphere and a radius ~ u^(1/n)."""
        direction = _normal(like, generator)
        sizes = self.sizes(direction)
        width = max(like.numel() // max(sizes.numel(), 1), 1)
        return _unit(direction, sizes) * (
            radius * _even(sizes.shape, generator, like) ** (1.0 / width)
        )

    def noise(self, delta: Tensor, generator: Generator) -> Tensor:
        """A direction from the sphere, as long as `delta`."""
        direction = _normal(delta, generator)
        return _unit(direction, self.sizes(direction)) * self.sizes(delta)


class L2PerGaussian(L2):
    """A Euclidean ball around every Gaussian's row: what the paper's code does."""

    def sizes(self, delta: Tensor) -> Tensor:
        """Norm of each row."""
        flat: Tensor = (delta.flatten(1) if delta.ndim > 1 else delta[:, None]).norm(
            dim=1
        )
        return flat.reshape(-1, *([1] * (delta.ndim - 1)))


NORMS: dict[NormName, Linf | L2] = {
    "linf": Linf(),
    "l2": L2(),
    "l2_per_gaussian": L2PerGaussian(),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Budget:
    """How far each attribute may move.

    Attributes:
        radius: Largest size of the perturbation by attribute, in the units of the splat
            file (SH coefficients, world units, log world units, quaternion components,
            logits), or of the threat (`attacks.threats`). What is not named may not
            move at all.
        norm: `linf`, `l2` (one ball over the object) or `l2_per_gaussian` (a ball per
            row).

    Raises:
        InvalidValueError: The norm is unknown, nothing may move, or a radius is
            negative or not finite.
    """

    radius: Mapping[str, float]
    norm: NormName = "l2"

    def __post_init__(self) -> None:
        check_choice("norm", self.norm, NORM_NAMES)
        if not self.radius:
            raise InvalidValueError.of(
                "radius",
                "at least one attribute",
                "none",
                "say what may move, and how far",
            )
        for name, value in self.radius.items():
            checked_number(
                f"radius of {name}",
                value,
                at_least(0, do="use a large one for 'no limit'"),
            )

    def project(self, parameters: Parameters, reference: Parameters) -> Parameters:
        """The nearest parameters inside the budget; what is inside comes back
        unchanged, bit for bit.

        Args:
            parameters: Tensors by attribute, each with one row for each Gaussian.
            reference: The clean tensors, of the same shapes: the middle of the ball.

        Returns:
            New parameters by attribute.
        """
        norm = NORMS[self.norm]
        return {
            name: _inside(value, reference[name], self.radius[name], norm)
            for name, value in parameters.items()
        }

    def measure(
        self, parameters: Parameters, reference: Parameters
    ) -> dict[str, float]:
        """Size of the perturbation by attribute.

        Args:
            parameters: Tensors by attribute, each with one row for each Gaussian.
            reference: The clean tensors, of the same shapes.

        Returns:
            A size for each attribute, in the norm.
        """
        norm = NORMS[self.norm]
        return {
            name: norm.measure(_difference(value, reference[name]))
            for name, value in parameters.items()
        }

    def check(self, parameters: Parameters, reference: Parameters) -> None:
        """Refuse parameters outside the budget.

        Args:
            parameters: Tensors by attribute, each with one row for each Gaussian.
            reference: The clean tensors, of the same shapes.

        Raises:
            BudgetError: A perturbation is larger than its radius, or not a number.
        """
        for name, size in self.measure(parameters, reference).items():
            if not size <= self.radius[name]:
                expected = f"<= {self.radius[name]}"
                do = "report this: the attack is wrong"
                raise BudgetError.of(f"{self.norm} of {name}", expected, size, do)

    def steepest(self, gradients: Parameters) -> Parameters:
        """Direction of steepest ascent by attribute, size 1 each, in the dtype of the
        gradients.

        Args:
            gradients: Of the loss, by attribute, in the shapes of the parameters.

        Returns:
            A direction for each attribute.
        """
        norm = NORMS[self.norm]
        return {
            name: norm.steepest(value.double()).to(value.dtype)
            for name, value in gradients.items()
        }

    def uniform(self, reference: Parameters, generator: Generator) -> Parameters:
        """Parameters drawn uniformly from the ball around the reference.

        Args:
            reference: The clean tensors by attribute: the middle of the ball.
            generator: Random numbers on the device of the tensors.

        Returns:
            New parameters by attribute, inside the budget.
        """
        norm = NORMS[self.norm]
        moved = {
            name: (
                (
                    value.double()
                    + norm.uniform(value.double(), self.radius[name], generator)
                ).to(value.dtype)
            )
            for name, value in reference.items()
        }
        return self.project(moved, reference)

    def noise(
        self, parameters: Parameters, reference: Parameters, generator: Generator
    ) -> Parameters:
        """The reference plus random noise as large as the perturbation of `parameters`.

        Args:
            parameters: The attacked tensors by attribute, whose distance from the
                reference the noise has.
            reference: The clean tensors, of the same shapes.
            generator: Random numbers on the device of the tensors.

        Returns:
            New parameters by attribute, inside the budget.
        """
        norm = NORMS[self.norm]
        moved = {}
        for name, value in parameters.items():
            noise = norm.noise(_difference(value, reference[name]), generator)
            moved[name] = (reference[name].double() + noise).to(value.dtype)
        return self.project(moved, reference)


def _difference(value: Tensor, reference: Tensor) -> Tensor:
    return value.detach().double() - reference.detach().double()


def _inside(value: Tensor, reference: Tensor, radius: float, norm: Linf | L2) -> Tensor:
    """Project one attribute; rounding to the tensor's dtype goes towards the reference,
    never out of the ball.
    """
    delta = _difference(value, reference)
    if norm.measure(delta) <= radius:
        return value
    delta = norm.shrink(delta, radius * (1 - _SLACK))
    rounded = (reference.double() + delta).to(value.dtype)
    too_far = _difference(rounded, reference).abs() > delta.abs()
    return torch.where(
        too_far, torch.nextafter(rounded, reference.to(value.dtype)), rounded
    )
