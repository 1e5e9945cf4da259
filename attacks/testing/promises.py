"""Promises of a contract: all are tried, and all that are broken are told at once."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

import torch
from torch import Tensor

from mi_splat.errors import MiSplatError, message
from mi_splat.maths.rotation import normalise
from mi_splat.maths.sh import coefficient_count, colour_to_dc
from mi_splat.scene import GaussianScene

STEPS = (0.3, 1.0, 3.0)
"""Lengths of the steps along a gradient that are tried, as multiples of the first."""


class ContractError(MiSplatError, AssertionError):
    """A plug-in that does not keep its contract.

    Attributes:
        broken: A line for each broken promise: its name, what was expected, what came,
            and what to do.
    """

    broken: tuple[str, ...] = ()


class _BrokenError(Exception):
    """One promise is broken; the text says how."""


class Contract:
    """The promises of one plug-in.

    Args:
        what: What it is, for the error, for instance "detector bright_spot".
    """

    def __init__(self, what: str) -> None:
        self._what = what
        self._broken: list[str] = []

    @contextmanager
    def promise(self, name: str) -> Iterator[None]:
        """What is done within is one promise; whatever it raises breaks it, and the
        next one is tried.
        """
        try:
            yield
        except _BrokenError as broken:
            self._broken.append(f"{name}: {broken}")
        except Exception as error:  # noqa: BLE001  # a plug-in may raise anything
            text = f"raised {type(error).__name__}: {error}"
            if not any(line.endswith(text) for line in self._broken):
                self._broken.append(f"{name}: {text}")

    def settle(self) -> None:
        """Raise if a promise is broken."""
        if self._broken:
            if len(self._broken) == 1:
                count = "a broken promise"
            else:
                count = f"{len(self._broken)} broken promises"
            error = ContractError(
                f"{self._what}: {count}\n"
                + "\n".join(f"- {line}" for line in self._broken)
            )
            error.what, error.broken = self._what, tuple(self._broken)
            raise error


def expect(kept: object, expected: object, got: object, do: str) -> None:
    """Break the promise at hand unless something holds."""
    if not kept:
        raise _BrokenError(message("", expected, got, do).removeprefix(": "))


def expect_text(value: object, what: str) -> None:
    """Break the promise unless something is a text that is not empty."""
    expect(
        isinstance(value, str) and value,
        f"a text as {what}",
        repr(value),
        f"give it a {what}",
    )


def expect_same(
    first: Sequence[Tensor],
    second: Sequence[Tensor],
    *,
    atol: float,
    expected: str,
    do: str,
) -> None:
    """Break the promise unless tensors are as many, and equal within a tolerance."""
    shapes = [[tuple(value.shape) for value in values] for values in (first, second)]
    expect(
        shapes[0] == shapes[1],
        expected,
        f"shapes {shapes[0][:4]} and {shapes[1][:4]}",
        do,
    )
    pairs = [
        (a.detach().double(), b.detach().double())
        for a, b in zip(first, second, strict=True)
        if a.numel()
    ]
    gap = max((float((a - b).abs().max()) for a, b in pairs), default=0.0)
    expect(gap <= atol, expected, f"values that are {gap:.3g} apart", do)


def expect_uphill(
    measured: Callable[[Tensor], Tensor], start: Tensor, step: float, *, do: str
) -> None:
    """Break the promise unless a number has a gradient that leads uphill as steeply as
    it says.
    """
    leaf = start.detach().clone().requires_grad_(True)
    with torch.enable_grad():
        value = measured(leaf)
    expect(value.requires_grad, "a gradient", "none", do)
    (gradient,) = torch.autograd.grad(value, leaf, materialize_grads=True)
    expect(
        bool(torch.isfinite(gradient).all()),
        "a finite gradient",
        "NaN or infinity in it",
        do,
    )
    largest = float(gradient.abs().max()) if gradient.numel() else 0.0
    expect(largest > 0, "a gradient", "zeros everywhere", do)
    direction = gradient / largest
    promised = float((gradient.double() * direction.double()).sum())
    slopes = []
    for factor in STEPS:
        length = factor * step
        with torch.no_grad():
            gain = float(measured(start + length * direction)) - float(
                measured(start - length * direction)
            )
        slopes.append(gain / (2 * length))
    steep = any(0.5 * promised <= slope <= 2 * promised for slope in slopes)
    got = f"slopes of {', '.join(f'{slope:.3g}' for slope in slopes)} along it"
    expect(steep, f"a gradient that is true: a slope of {promised:.3g}", got, do)


def expect_repeatable(
    look: Callable[[], Sequence[Tensor]], expected: str, do: str, *, atol: float = 0.0
) -> None:
    """Break the promise unless a second look, with another seed of torch's global
    generator, gives the same.
    """
    first = look()
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(1)
        second = look()
    expect_same(first, second, atol=atol, expected=expected, do=do)


def cloud(count: int, degree: int, *, size: float = 1.0) -> GaussianScene:
    """Healthy Gaussians at random, of muted colours."""
    generator = torch.Generator().manual_seed(0)
    sh = 0.02 * torch.randn(count, coefficient_count(degree), 3, generator=generator)
    sh[:, 0] = colour_to_dc(0.2 + 0.6 * torch.rand(count, 3, generator=generator))
    return GaussianScene(
        means=torch.rand(count, 3, generator=generator) - 0.5,
        scales=size * (0.02 + 0.05 * torch.rand(count, 3, generator=generator)),
        rotations=normalise(torch.randn(count, 4, generator=generator)),
        opacities=0.3 + 0.6 * torch.rand(count, generator=generator),
        sh=sh,
    )
