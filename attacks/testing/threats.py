"""The contract of a threat: what searches, budgets and results rely on."""

from __future__ import annotations

import torch
from torch import Tensor

from attacks.gaussian_subset import GaussianSubset
from attacks.testing.promises import Contract, cloud, expect
from attacks.threats import Threat
from mi_splat.attributes import ATTRIBUTES

_COUNT = 40
_STEP = 1e-3
_CLOSE = 1e-4


def check_threat(threat: Threat) -> None:
    """Raise unless a threat keeps its contract.

    Its clean value changes no bit of the object, it changes the attributes that it says
    and no others, their shapes stay, and its derivative is that of finite differences.

    Args:
        threat: The threat, which need not be registered.

    Raises:
        ContractError: It does not; the message lists all that is wrong.
    """
    contract = Contract(f"threat {threat.name}")
    subset = GaussianSubset.of(cloud(_COUNT, degree=1, size=0.5), slice(None))
    start = threat.start(subset.clean)
    with contract.promise("the clean value"):
        for name, value in threat.apply(start, subset.clean).items():
            expect(
                torch.equal(value, subset.clean[name]),
                f"{name} as they were, to the bit",
                "others",
                "add a change that is zero there",
            )
    with contract.promise("what changes"):
        generator = torch.Generator().manual_seed(0)
        noise = 0.1 * torch.randn(start.shape, generator=generator).to(start)
        changed = threat.apply(start + noise, subset.clean)
        expect(
            set(changed) == set(threat.changes) and set(changed) <= {*ATTRIBUTES},
            f"the attributes {', '.join(threat.changes)}",
            ", ".join(changed) or "none",
            "name them all in `changes`, and no others",
        )
        for name, value in changed.items():
            expect(
                value.shape == subset.clean[name].shape,
                f"{name} of shape {tuple(subset.clean[name].shape)}",
                tuple(value.shape),
                "keep one row for each Gaussian",
            )
    contract.settle()
    with contract.promise("the derivative"):
        _check_slope(threat, {name: v.double() for name, v in subset.clean.items()})
    contract.settle()


def _check_slope(threat: Threat, clean: dict[str, Tensor]) -> None:
    """Compare the derivative in one direction with a central difference, at the clean
    value and elsewhere.
    """
    generator = torch.Generator().manual_seed(1)
    start = threat.start(clean)
    direction = torch.randn(start.shape, generator=generator).to(start)
    weights = {
        name: torch.randn(clean[name].shape, generator=generator).to(clean[name])
        for name in threat.changes
    }

    def total(value: Tensor) -> Tensor:
        changed = threat.apply(value, clean)
        return torch.stack(
            [(changed[name] * weight).sum() for name, weight in weights.items()]
        ).sum()

    for share in (0.0, 0.2):
        value = (start + share * direction).requires_grad_(True)
        (gradient,) = torch.autograd.grad(total(value), value)
        slope = float((gradient * direction).sum())
        with torch.no_grad():
            up = float(total(value + _STEP * direction))
            down = float(total(value - _STEP * direction))
        wanted = (up - down) / (2 * _STEP)
        expect(
            abs(slope - wanted) <= _CLOSE * max(1.0, abs(wanted)),
            f"a slope of {wanted:.6g}",
            f"{slope:.6g}",
            "let torch differentiate it, without .detach() or .item()",
        )
