"""Budgets: how far each attribute of the attacked Gaussians may move, and in which norm.

A perturbation lives in the space of the splat file: SH coefficients, means in world units, log-scales, quaternions
before normalisation, logit opacities. A norm is a small value that measures a perturbation, shrinks it into the ball,
gives the steepest direction, and draws from the ball; everything else is the same for all norms. Parameters are one
tensor for each attribute that may move, whose first dimension is the Gaussian.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Generator, Tensor

from attacks.limits import NORM_NAMES, NormName
from attacks.pgd import Parameters
from mi_splat.attributes import ATTRIBUTES
from mi_splat.errors import InvalidValueError, MiSplatError, message
from mi_splat.fields import at_least, check_choice, checked_number

_SLACK = 1e-12
"""Projection aims this much inside, relative to the radius: float64 rounding of the norm cannot leave the ball."""


class BudgetError(MiSplatError):
    """An attack left its budget: a bug in the attack, never the user's fault."""


class Norm(Protocol):
    """What an attack needs of a norm. Perturbations are float64; the first dimension is the Gaussian."""

    def measure(self, delta: Tensor) -> float:
        """Size of the perturbation, compared with the radius."""
        ...

    def shrink(self, delta: Tensor, radius: float) -> Tensor:
        """The nearest perturbation in the ball; no element grows or changes sign."""
        ...

    def steepest(self, gradient: Tensor) -> Tensor:
        """Direction of steepest ascent of size 1; zero where the gradient is zero."""
        ...

    def uniform(self, like: Tensor, radius: float, generator: Generator) -> Tensor:
        """A draw from the uniform distribution on the ball."""
        ...

    def noise(self, delta: Tensor, generator: Generator) -> Tensor:
        """Random noise of exactly the size of `delta`: the control that an attack has to beat."""
        ...


def _normal(like: Tensor, generator: Generator) -> Tensor:
    # Drawn on the CPU, so that a seed means the same noise on every device.
    return torch.randn(like.shape, generator=generator, dtype=torch.float64).to(like.device)


def _unit(delta: Tensor, size: Tensor) -> Tensor:
    return torch.where(size > 0, delta / torch.where(size > 0, size, 1.0), 0.0)


@dataclass(frozen=True, slots=True)
class Linf:
    """The largest change of any one coefficient."""

    def measure(self, delta: Tensor) -> float:
        """Largest absolute value."""
        return float(delta.abs().max()) if delta.numel() else 0.0

    def shrink(self, delta: Tensor, radius: float) -> Tensor:
        """Clip every element."""
        return delta.clamp(-radius, radius)

    def steepest(self, gradient: Tensor) -> Tensor:
        """The sign."""
        return gradient.sign()

    def uniform(self, like: Tensor, radius: float, generator: Generator) -> Tensor:
        """Uniform in the cube."""
        draw: Tensor = 2 * torch.rand(like.shape, generator=generator, dtype=torch.float64) - 1
        return draw.to(like.device) * radius

    def noise(self, delta: Tensor, generator: Generator) -> Tensor:
        """Random signs at full size."""
        return _normal(delta, generator).sign() * self.measure(delta)


@dataclass(frozen=True, slots=True)
class L2:
    """One Euclidean ball over the attribute of the whole object: the PGD of the paper's text."""

    def measure(self, delta: Tensor) -> float:
        """Euclidean norm of everything."""
        return float(delta.norm())

    def shrink(self, delta: Tensor, radius: float) -> Tensor:
        """Scale down."""
        size = self.measure(delta)
        return delta if size <= radius else delta * (radius / size)

    def steepest(self, gradient: Tensor) -> Tensor:
        """The gradient over its norm."""
        # The two-step scaling keeps gradients of 1e-30 from vanishing when they are squared.
        scaled = _unit(gradient, gradient.abs().amax() if gradient.numel() else gradient.new_zeros(()))
        return _unit(scaled, scaled.norm())

    def uniform(self, like: Tensor, radius: float, generator: Generator) -> Tensor:
        """A direction from the sphere and a radius ~ u^(1/n)."""
        direction = _normal(like, generator)
        fraction = math.pow(float(torch.rand((), generator=generator, dtype=torch.float64)), 1 / max(like.numel(), 1))
        return _unit(direction, direction.norm()) * (radius * fraction)

    def noise(self, delta: Tensor, generator: Generator) -> Tensor:
        """A direction from the sphere."""
        direction = _normal(delta, generator)
        return _unit(direction, direction.norm()) * self.measure(delta)


@dataclass(frozen=True, slots=True)
class L2PerGaussian:
    """A Euclidean ball around every Gaussian's row: what the paper's code does."""

    def measure(self, delta: Tensor) -> float:
        """Largest norm of a row."""
        return float(_rows(delta).max()) if delta.numel() else 0.0

    def shrink(self, delta: Tensor, radius: float) -> Tensor:
        """Scale down the rows that are too long."""
        size = _rows(delta)
        return torch.where(size > radius, delta * (radius / size.clamp(min=1e-300)), delta)

    def steepest(self, gradient: Tensor) -> Tensor:
        """Every row over its norm."""
        if not gradient.numel():
            return gradient
        scaled = _unit(gradient, gradient.abs().amax())
        return _unit(scaled, _rows(scaled))

    def uniform(self, like: Tensor, radius: float, generator: Generator) -> Tensor:
        """Every row on its own."""
        direction = _normal(like, generator)
        size = _rows(direction)
        width = max(like[0].numel() if len(like) else 1, 1)
        fraction = torch.rand(size.shape, generator=generator, dtype=torch.float64).to(like.device) ** (1.0 / width)
        return _unit(direction, size) * (radius * fraction)

    def noise(self, delta: Tensor, generator: Generator) -> Tensor:
        """Every row in a random direction at its own size."""
        direction = _normal(delta, generator)
        return _unit(direction, _rows(direction)) * _rows(delta)


def _rows(delta: Tensor) -> Tensor:
    """Norm of each row, shaped to broadcast against `delta`."""
    flat: Tensor = (delta.flatten(1) if delta.ndim > 1 else delta[:, None]).norm(dim=1)
    return flat.reshape(-1, *([1] * (delta.ndim - 1)))


NORMS: dict[NormName, Norm] = {"linf": Linf(), "l2": L2(), "l2_per_gaussian": L2PerGaussian()}


@dataclass(frozen=True, slots=True, kw_only=True)
class Budget:
    """How far each attribute may move.

    Attributes:
        radius: Largest size of the perturbation by attribute, in the units of the splat file (SH coefficients, world
            units, log world units, quaternion components, logits). Attributes that are not named may not move at all.
        norm: `linf`, `l2` (one ball over the object) or `l2_per_gaussian` (a ball per row).

    Raises:
        InvalidValueError: An attribute or the norm is unknown, nothing may move, or a radius is negative or not finite.
    """

    radius: Mapping[str, float]
    norm: NormName = "l2"

    def __post_init__(self) -> None:
        check_choice("norm", self.norm, NORM_NAMES)
        if not self.radius:
            do = "say what may move, and how far"
            raise InvalidValueError(message("radius", "at least one attribute", "none", do))
        for name, value in self.radius.items():
            check_choice("attribute", name, ATTRIBUTES)
            checked_number(f"radius of {name}", value, at_least(0, do="use a large one for 'no limit'"))

    def project(self, parameters: Parameters, reference: Parameters) -> Parameters:
        """The nearest parameters inside the budget; what is inside comes back unchanged, bit for bit."""
        norm = NORMS[self.norm]
        return {name: _inside(value, reference[name], self.radius[name], norm) for name, value in parameters.items()}

    def measure(self, parameters: Parameters, reference: Parameters) -> dict[str, float]:
        """Size of the perturbation by attribute."""
        norm = NORMS[self.norm]
        return {name: norm.measure(_difference(value, reference[name])) for name, value in parameters.items()}

    def check(self, parameters: Parameters, reference: Parameters) -> None:
        """Refuse parameters outside the budget.

        Raises:
            BudgetError: A perturbation is larger than its radius, or not a number.
        """
        for name, size in self.measure(parameters, reference).items():
            if not size <= self.radius[name]:
                raise BudgetError(
                    message(
                        f"{self.norm} of {name}", f"<= {self.radius[name]}", size, "report this: the attack is wrong"
                    )
                )

    def steepest(self, gradients: Parameters) -> Parameters:
        """Direction of steepest ascent by attribute, size 1 each, in the dtype of the gradients."""
        norm = NORMS[self.norm]
        return {name: norm.steepest(value.double()).to(value.dtype) for name, value in gradients.items()}

    def uniform(self, reference: Parameters, generator: Generator) -> Parameters:
        """Parameters drawn uniformly from the ball around the reference."""
        norm = NORMS[self.norm]
        moved = {
            name: (value.double() + norm.uniform(value.double(), self.radius[name], generator)).to(value.dtype)
            for name, value in reference.items()
        }
        return self.project(moved, reference)

    def noise(self, parameters: Parameters, reference: Parameters, generator: Generator) -> Parameters:
        """The reference plus random noise as large as the perturbation of `parameters`."""
        norm = NORMS[self.norm]
        moved = {
            name: (reference[name].double() + norm.noise(_difference(value, reference[name]), generator)).to(
                value.dtype
            )
            for name, value in parameters.items()
        }
        return self.project(moved, reference)


def _difference(value: Tensor, reference: Tensor) -> Tensor:
    return value.detach().double() - reference.detach().double()


def _inside(value: Tensor, reference: Tensor, radius: float, norm: Norm) -> Tensor:
    """Project one attribute; rounding to the tensor's dtype goes towards the reference, never out of the ball."""
    delta = _difference(value, reference)
    if norm.measure(delta) <= radius:
        return value
    delta = norm.shrink(delta, radius * (1 - _SLACK))
    rounded = (reference.double() + delta).to(value.dtype)
    too_far = _difference(rounded, reference).abs() > delta.abs()
    return torch.where(too_far, torch.nextafter(rounded, reference.to(value.dtype)), rounded)
