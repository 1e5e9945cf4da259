"""Starting points."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from mi_splat.cameras import project_points
from mi_splat.datasets import load_dataset
from mi_splat.errors import InvalidValueError
from mi_splat.io.points import PointCloud
from mi_splat.sh import colour_to_dc
from mi_splat.training.initialization import from_points, random_points, spacing, thinned, with_outliers
from mi_splat.training.loop import scene_extent
from tests.training.sets import views_of, write_set


def test_spacing_is_the_distance_to_the_nearest() -> None:
    grid = torch.cartesian_prod(*[torch.arange(4.0)] * 3)
    assert torch.allclose(spacing(grid), torch.ones(64))
    assert torch.allclose(spacing(1000 + 0.01 * grid), torch.full((64,), 0.01), rtol=0.02)
    assert spacing(grid[:1]).tolist() == [1.0]


def test_points_become_round_gaussians_of_their_colour() -> None:
    points, colours = torch.rand(50, 3), torch.rand(50, 3)
    start = from_points(points, colours)
    assert torch.equal(start.means, points)
    assert torch.allclose(start.sh[:, 0], colour_to_dc(colours))
    assert torch.equal(start.scales[:, 0], start.scales[:, 2])
    with pytest.raises(InvalidValueError, match="two of shape"):
        from_points(points, colours[:3])


def test_random_points_lie_where_the_cameras_look() -> None:
    _, views = views_of()
    start = random_points(views, 200, seed=3)
    assert float(start.means.mean(0).norm()) < 0.5
    assert float(start.means.abs().max()) <= 2.1  # half of the cameras' distance
    assert torch.equal(start.means, random_points(views, 200, seed=3).means)
    assert not torch.equal(start.means, random_points(views, 200, seed=4).means)


def test_outliers_lie_between_cameras_and_points() -> None:
    _, views = views_of()
    cloud = PointCloud(
        torch.tensor([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0]]), torch.tensor([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    )
    found = with_outliers(cloud, views, 50, seed=3)
    assert torch.equal(found.points[:2], cloud.points)
    assert torch.equal(found.colours[:2], cloud.colours)
    eyes = torch.stack([view.camera.position for view in views]).float()
    for place, colour in zip(found.points[2:], found.colours[2:], strict=True):
        point = cloud.points[int(colour[1])]
        way = torch.linalg.norm(place - eyes, dim=1) / torch.linalg.norm(point - eyes, dim=1)
        rest = torch.linalg.norm(place - point) / torch.linalg.norm(point - eyes, dim=1)
        eye = int((way + rest).argmin())
        assert float(way[eye] + rest[eye]) == pytest.approx(1, abs=1e-5)
        assert 0.1 - 1e-5 <= float(way[eye]) <= 0.9 + 1e-5
    assert torch.equal(with_outliers(cloud, views, 50, seed=3).points, found.points)
    assert not torch.equal(with_outliers(cloud, views, 50, seed=4).points, found.points)
    assert torch.equal(with_outliers(cloud, views, 0).points, cloud.points)
    for count, some in ((-1, views), (1, [])):
        with pytest.raises(InvalidValueError, match="count, views and points"):
            with_outliers(cloud, some, count)


def test_a_training_is_set_up_without_reading_pictures(tmp_path: Path) -> None:
    dataset = write_set(tmp_path / "set")
    views = load_dataset(dataset)
    before, start = scene_extent(list(views)), random_points(list(views), 5)
    views = load_dataset(dataset)
    for path in views.paths:
        path.unlink()
    assert scene_extent(views) == before
    assert torch.equal(random_points(views, 5).means, start.means)


def test_sizes_and_opacities_are_those_of_3dgs() -> None:
    """Root mean square of the distances to three neighbours, opacity 0.1 (Kerbl et al. 2023)."""
    points = torch.tensor([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 2.0, 0.0], [0.0, 0.0, 3.0], [9.0, 9.0, 9.0]])
    start = from_points(points, torch.full((5, 3), 0.5))
    assert float(start.scales[0, 0]) == pytest.approx(((1 + 4 + 9) / 3) ** 0.5)
    assert start.opacities.tolist() == pytest.approx([0.1] * 5)


def test_outliers_lie_in_three_pictures_and_all_along_the_way() -> None:
    _, views = views_of()
    cloud = PointCloud(torch.tensor([[0.0, 0.0, 0.0]]), torch.full((1, 3), 0.5))
    drawn = with_outliers(cloud, views, 400, seed=1).points[1:]
    eyes = torch.stack([view.camera.position for view in views]).float()
    ways = (drawn.norm(dim=1) / eyes.norm(dim=1).mean()).sort().values  # what is left of the way to the point
    assert float(ways[0]) == pytest.approx(0.1, abs=0.02)
    seen = torch.zeros(400)
    for view in views:
        pixels, depth = project_points(drawn.double(), view.camera)
        size = pixels.new_tensor([view.camera.width, view.camera.height])
        seen += ((depth > 0) & ((pixels >= 0) & (pixels < size)).all(1)).float()
    assert float(seen.min()) >= 3


def test_a_thinned_cloud_keeps_its_order_and_colours() -> None:
    cloud = PointCloud(torch.arange(300.0).reshape(100, 3), torch.arange(300.0).reshape(100, 3) / 300)
    few = thinned(cloud, 40, seed=1)
    assert len(few.points) == 40
    assert (few.points[1:, 0] > few.points[:-1, 0]).all()
    assert torch.equal(few.colours, few.points / 300)
    assert torch.equal(few.points, thinned(cloud, 40, seed=1).points)
    assert not torch.equal(few.points, thinned(cloud, 40, seed=2).points)
    assert thinned(cloud, 100) is cloud
