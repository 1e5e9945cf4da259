"""Noise that is matched to an attack: as close as it says, in few images."""

from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch import Tensor

from attacks.dagger.controls import TOLERANCE, _matched, _mean, _object_errors
from attacks.search.parameters import Parameters


class Pictures:
    """Images of 40 views that follow a vector of colours, darken and saturate; they are
    counted.
    """

    def __init__(self, *, gain: float) -> None:
        self.count = 0
        self.gain = gain
        generator = torch.Generator().manual_seed(0)
        self.light = torch.rand(40, 8, 8, 3, generator=generator)

    def image(self, parameters: Parameters, camera: int) -> Tensor:
        self.count += 1
        change: Tensor = self.gain * parameters["sh"].mean(0)[camera % 3]
        return (self.light[camera] + change * (1 + self.light[camera])).clamp(0, 1)

    def clean(self, camera: int) -> Tensor:
        return self.light[camera]


@pytest.mark.parametrize("gain", [0.001, 0.05, 1.0, 30.0])
@pytest.mark.parametrize("number", [1, 40])
def test_noise_is_matched_in_few_looks_at_the_views(gain: float, number: int) -> None:
    generator = torch.Generator().manual_seed(1)
    reference = {"sh": torch.zeros(50, 4, 3)}
    attacked, noisy = (
        {"sh": torch.randn(50, 4, 3, generator=generator)} for _ in range(2)
    )
    views: Any = [
        SimpleNamespace(camera=camera, on_object=torch.ones(8, 8) > 0)
        for camera in range(number)
    ]
    wanted = _object_errors(Pictures(gain=0.4), attacked, views)  # type: ignore[arg-type]
    pictures: Any = Pictures(gain=gain)
    matched = _matched(pictures, noisy, reference, views, wanted)
    assert pictures.count <= (7 if number == 1 else 2 * number + 6 * 7)
    error = _mean(_object_errors(pictures, matched, views))
    assert abs(10 * float(torch.tensor(error / _mean(wanted)).log10())) <= TOLERANCE
