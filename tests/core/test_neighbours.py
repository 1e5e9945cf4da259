"""Neighbours by a tree: the bits of a search of all with all, in the memory and the
time of far less.
"""

import subprocess
import sys
import time
from collections.abc import Callable

import pytest
import torch
from torch import Tensor
from torch.nn import functional

from mi_splat.errors import InvalidValueError
from mi_splat.maths.neighbours import nearest_distances, nearest_neighbours, nearest_of
from mi_splat.training.initialization import spacing


def _random(count: int) -> Tensor:
    return torch.rand(count, 3, generator=torch.Generator().manual_seed(count))


def _grid(step: float, offset: float) -> Tensor:
    return torch.cartesian_prod(*[torch.arange(10.0)] * 3) * step + offset


CLOUDS: dict[str, Callable[[], Tensor]] = {
    "two": lambda: _random(2),
    "four": lambda: _random(4),
    "nine": lambda: _random(9),
    "many": lambda: _random(1500),
    "far from the origin": lambda: 1000 + _random(1500),
    "tiny": lambda: 1e-15 * _random(1500),
    "huge": lambda: 1e15 * _random(1500),
    "grid": lambda: _grid(1.0, 0.0),
    "grid that rounds": lambda: _grid(0.1, 0.37),
    "grid far away": lambda: _grid(0.013, 100.0),
    "copies": lambda: _random(150).repeat(10, 1),
    "one place": lambda: _random(1).expand(500, 3),
    "sphere with its centre": lambda: torch.cat(
        [functional.normalize(_random(1500) - 0.5), torch.zeros(1, 3)]
    ),
    "on a lattice of sevenths": lambda: (_random(1500) * 16).round() / 7,
}


@pytest.mark.parametrize("name", CLOUDS)
def test_distances_are_to_the_bit_those_of_all_with_all(name: str) -> None:
    points = CLOUDS[name]()
    count = min(3, len(points) - 1)
    gaps = torch.cdist(points, points, compute_mode="donot_use_mm_for_euclid_dist")
    wanted = gaps.topk(count + 1, largest=False).values[:, 1:]
    assert torch.equal(nearest_distances(points, count), wanted)
    assert torch.equal(spacing(points), wanted.square().mean(1).sqrt())


def test_points_that_are_not_finite_are_named() -> None:
    points = _random(5)
    points[3, 1] = torch.nan
    with pytest.raises(
        InvalidValueError, match=r"points: expected finite coordinates, got .* in row 3"
    ):
        spacing(points)


def test_points_in_one_place_take_no_more_time_than_others() -> None:
    points = torch.zeros(60_000, 3)
    points[0] = 1
    begun = time.process_time()
    distances, rows = nearest_neighbours(points, 8)
    nearest = nearest_of(points, 2)
    assert time.process_time() - begun < 3  # all with all: 12 s
    assert not distances[1:].any()
    assert not (rows == torch.arange(len(points))[:, None]).any()
    assert not points[nearest[1:]].any()
    assert nearest[0] == 0


MEMORY = """
import resource, torch
from mi_splat.maths.neighbours import nearest_neighbours
from mi_splat.scene import GaussianScene
from mi_splat.selection.clusters import clusters
from mi_splat.training.initialization import from_points
from mi_splat.training.strategies import MCMCConfig
from mi_splat.training.strategies.mcmc import relocate
from mi_splat.io.parameters import to_raw_parameters

points = torch.randn(60_000, 3, generator=torch.Generator().manual_seed(0))
scene = from_points(points[:100], torch.zeros(100, 3))  # everything is loaded
clusters(scene)
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
scene = from_points(points, torch.zeros_like(points))
clusters(scene)
parameters = to_raw_parameters(scene)
parameters["opacities"][::10] = -9.0
relocate(parameters, config=MCMCConfig(), generator=torch.Generator().manual_seed(0))
print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before)
"""


def test_work_on_60_000_points_stays_within_200_megabytes() -> None:
    done = subprocess.run(
        [sys.executable, "-c", MEMORY], capture_output=True, text=True, check=True
    )
    unit = 1 if sys.platform == "darwin" else 1024
    # distances of all with all: 14 GB, or blocks of gigabytes
    assert int(done.stdout) * unit < 200 << 20
