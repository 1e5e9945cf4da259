"""The parametrisation of splat files as differentiable functions."""

from __future__ import annotations

import math
import re

import pytest
import torch
from torch import Tensor

from mi_splat.errors import InvalidValueError
from mi_splat.io import from_raw_parameters, to_raw_parameters
from mi_splat.io.parameters import activate
from mi_splat.scene import ATTRIBUTES, GaussianScene
from tests.gaussians import random_scene


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_ends_of_the_opacities_are_exact_in_both_dtypes(dtype: torch.dtype) -> None:
    scene = random_scene(3, dtype=dtype)
    opacities = torch.tensor([0.0, 1.0, 0.5], dtype=dtype)
    values = to_raw_parameters(scene.replace(opacities=opacities))
    assert values["opacities"].dtype == dtype
    assert torch.isfinite(values["opacities"]).all()
    assert torch.equal(from_raw_parameters(values).opacities, opacities)


def test_both_directions_are_differentiable() -> None:
    scene = random_scene(3, 1, dtype=torch.float64)
    leaves = [value.clone().requires_grad_() for value in scene.tensors()]

    def there(*tensors: Tensor) -> tuple[Tensor, ...]:
        return tuple(to_raw_parameters(GaussianScene.unchecked(*tensors)).values())

    def back(*tensors: Tensor) -> tuple[Tensor, ...]:
        return activate(dict(zip(ATTRIBUTES, tensors, strict=True)))

    assert torch.autograd.gradcheck(there, leaves)
    values = [value.detach().clone() for value in there(*leaves)]
    values[2] *= torch.tensor([[0.5], [2.0], [3.0]])  # away from unit length, where the bits are kept
    assert torch.autograd.gradcheck(back, [value.requires_grad_() for value in values])


def test_gradients_at_the_ends_are_zero_not_nan() -> None:
    opacities = torch.tensor([0.0, 1.0, 0.5], requires_grad=True)
    scene = random_scene(3).replace(opacities=opacities)
    (gradient,) = torch.autograd.grad(to_raw_parameters(scene)["opacities"].sum(), opacities)
    torch.testing.assert_close(gradient, torch.tensor([0.0, 0.0, 4.0]))


def test_largest_scales_stay_finite() -> None:
    for dtype in (torch.float32, torch.float64):
        scene = random_scene(1, dtype=dtype)
        means, _, *others = scene.tensors()
        big = GaussianScene.unchecked(means, torch.full((1, 3), torch.finfo(dtype).max, dtype=dtype), *others)
        assert torch.isfinite(activate(to_raw_parameters(big))[1]).all()


@pytest.mark.parametrize(("log_scale", "got"), [(89.0, "inf"), (-120.0, "0"), (math.nan, "nan")])
def test_log_scales_out_of_range_are_refused(log_scale: float, got: str) -> None:
    values = to_raw_parameters(random_scene(2))
    values["scales"] = torch.full((2, 3), log_scale)
    with pytest.raises(
        InvalidValueError, match=rf"^scales: expected finite values > 0 up to 1e\+09, got {got} in row 0"
    ):
        from_raw_parameters(values)


def test_names_must_be_the_five() -> None:
    values = to_raw_parameters(random_scene(2))
    with pytest.raises(InvalidValueError, match=re.escape("values: expected the names ('means'")):
        from_raw_parameters({name: values[name] for name in ATTRIBUTES[1:]})
