"""Neighbours, planes and connected components, against plain references."""

import numpy as np
import pytest
import torch
from torch import Tensor

from mi_splat import oracle
from mi_splat.cameras.camera import RenderFn
from mi_splat.maths.neighbours import nearest_neighbours
from mi_splat.maths.sh import colour_to_dc
from mi_splat.render.renderer import Renderer, RenderSettings
from mi_splat.scene import GaussianScene, merge
from mi_splat.selection.clusters import clusters, components, find_plane
from mi_splat.selection.visibility import contributions
from tests.gaussians import varied_scene
from tests.rendering.test_rasterization import camera
from tests.selection.bare import ground


def shell(
    count: int, *, centre: tuple[float, float, float], radius: float, seed: int = 0
) -> Tensor:
    """(count, 3) points on a sphere."""
    points = torch.randn(count, 3, generator=torch.Generator().manual_seed(seed))
    return torch.tensor(centre) + radius * torch.nn.functional.normalize(points, dim=1)


def gaussians(points: Tensor, colour: tuple[float, float, float]) -> GaussianScene:
    """Small round Gaussians of one colour."""
    count = len(points)
    return GaussianScene(
        means=points,
        scales=torch.full((count, 3), 0.01),
        rotations=torch.tensor([1.0, 0.0, 0.0, 0.0]).expand(count, 4).contiguous(),
        opacities=torch.full((count,), 0.9),
        sh=colour_to_dc(torch.tensor(colour)).expand(count, 1, 3).contiguous(),
    )


@pytest.mark.parametrize("count", [2, 3, 300])
def test_neighbours_are_those_of_a_full_search(count: int) -> None:
    points = shell(count, centre=(1e3, 0.0, 0.0), radius=1.0).double()
    distances, rows = nearest_neighbours(points, 8)
    gaps = torch.cdist(
        points, points, compute_mode="donot_use_mm_for_euclid_dist"
    ).fill_diagonal_(float("inf"))
    exact = gaps.topk(min(8, count - 1), largest=False)
    torch.testing.assert_close(distances, exact.values)
    assert torch.equal(rows, exact.indices)


def test_neighbours_of_one_point_and_of_points_in_one_place() -> None:
    assert nearest_neighbours(torch.zeros(1, 3), 4)[1].shape == (1, 0)
    distances, rows = nearest_neighbours(torch.zeros(200, 3), 4)
    assert not distances.any()
    assert not (rows == torch.arange(200)[:, None]).any()


def test_components_are_numbered_by_their_first_nodes() -> None:
    edges = torch.tensor([[5, 1], [2, 4], [4, 6], [1, 3]])
    assert components(7, edges[:, 0], edges[:, 1]).tolist() == [0, 1, 2, 1, 2, 1, 2]
    assert components(2, edges[:0, 0], edges[:0, 1]).tolist() == [0, 1]


def test_a_plane_is_found_whatever_its_direction() -> None:
    generator = torch.Generator().manual_seed(3)
    turn = torch.linalg.qr(
        torch.randn(3, 3, generator=generator, dtype=torch.float64)
    ).Q
    flat = torch.rand(600, 3, generator=generator, dtype=torch.float64) * torch.tensor(
        [4.0, 4.0, 0.01]
    )
    ball = shell(400, centre=(2.0, 2.0, 1.0), radius=0.5).double()
    points = torch.cat([flat, ball]) @ turn + 100
    plane = find_plane(points, nearest_neighbours(points, 8)[0][:, -1], least=500)
    assert plane is not None
    assert plane[:600].double().mean() > 0.98
    assert plane[600:].double().mean() < 0.1


def test_a_ball_has_no_plane() -> None:
    points = shell(2000, centre=(0.0, 0.0, 0.0), radius=1.0).double()
    assert (
        find_plane(points, torch.full((2000,), 0.01, dtype=torch.float64), least=100)
        is None
    )
    assert find_plane(points[:2], torch.ones(2), least=1) is None
    # no three of them make a plane
    assert find_plane(torch.zeros(10, 3), torch.ones(10), least=1) is None


@pytest.fixture
def on_the_ground() -> GaussianScene:
    """Two balls that touch the ground, the second much finer than the first; 800, 500
    and 3,000 Gaussians.
    """
    coarse = gaussians(shell(800, centre=(-1.0, 0.0, 0.5), radius=0.5), (0.8, 0.1, 0.1))
    fine = gaussians(shell(500, centre=(1.0, 0.0, 0.1), radius=0.1), (0.1, 0.1, 0.8))
    return merge(coarse, fine, ground(3000, half=3.0))


def test_what_stands_on_a_plane_is_apart(on_the_ground: GaussianScene) -> None:
    labels = clusters(on_the_ground)
    sizes = labels.bincount()
    assert (sizes.diff() <= 0).all()  # from the largest
    assert [int(labels[row]) for row in (4000, 400, 1000)] == [0, 1, 2]
    for number, rows in ((1, slice(0, 800)), (2, slice(800, 1300))):
        mine = labels == number
        # the underside goes to the ground
        assert int(mine[rows].sum()) > 0.85 * (rows.stop - rows.start)
        assert int(mine.sum()) == int(mine[rows].sum())


def test_order_and_size_of_the_world_do_not_matter(
    on_the_ground: GaussianScene,
) -> None:
    order = torch.randperm(len(on_the_ground))
    moved = on_the_ground.replace(
        means=on_the_ground.means * 1000, scales=on_the_ground.scales * 1000
    )
    first = clusters(on_the_ground)[order]
    second = clusters(moved.select(order))
    assert float(((first == 1) == (second == 1)).double().mean()) > 0.999


def test_colour_tells_what_touches_apart() -> None:
    red = gaussians(shell(600, centre=(0.0, 0.0, 0.0), radius=0.5), (0.8, 0.1, 0.1))
    blue = gaussians(shell(400, centre=(0.0, 0.0, 0.9), radius=0.5), (0.1, 0.1, 0.8))
    scene = merge(red, blue)
    assert int((clusters(scene, planes=0) == 0).sum()) == 1000
    labels = clusters(scene, planes=0, link_colour=0.2)
    assert int((labels[:600] == 0).sum()) > 590
    assert int((labels[600:] == 1).sum()) > 390


# Weights of Gaussians and of objects in images, against the float64 oracle and
# against each other


SCENE = varied_scene(150, degree=2, seed=5)
HERE = camera(40, 31)
THERE = camera(24, 24, azimuth=200.0)
GREY = RenderSettings(background=(0.3, 0.5, 0.7))


def test_contributions_are_the_oracles_weights(variant: str) -> None:
    boxes = [(5, 3, 30, 20), (7, 9, 8, 10)]
    whole = contributions(SCENE, [HERE, THERE], render=Renderer(GREY)).numpy()
    parts = contributions(
        SCENE, [HERE, THERE], render=Renderer(GREY), boxes=boxes
    ).numpy()
    for number, view in enumerate((HERE, THERE)):
        x0, y0, x1, y1 = boxes[number]
        sums = np.zeros(len(SCENE))
        in_box = np.zeros(len(SCENE))
        for layer in oracle.blend(oracle.project(SCENE, view), view):
            weights = np.zeros((view.height, view.width))
            weights[layer.box] = layer.weight
            sums[layer.number] = weights.sum()
            in_box[layer.number] = weights[y0:y1, x0:x1].sum()
        np.testing.assert_allclose(whole[:, number], sums, rtol=1e-5, atol=1e-5)
        np.testing.assert_allclose(parts[:, number], in_box, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize(
    "render",
    [Renderer(), Renderer(GREY), Renderer(RenderSettings(method="ray", alpha=True))],
)
def test_contributions_add_up_to_the_opacity(render: RenderFn, variant: str) -> None:
    method = render.settings.method if isinstance(render, Renderer) else "tile"
    alpha = Renderer(RenderSettings(method=method, alpha=True))(SCENE, HERE)[..., 3]
    weights = contributions(SCENE, HERE, render=render)
    assert float(weights.sum()) == pytest.approx(float(alpha.sum()), rel=1e-5)
    x = 20
    y = 15
    pixel = contributions(SCENE, HERE, render=render, boxes=[(x, y, x + 1, y + 1)])
    assert float(pixel.sum()) == pytest.approx(float(alpha[y, x]), rel=1e-5)


def test_rows_and_gradients_of_the_scene_change_nothing(variant: str) -> None:
    weights = contributions(SCENE, [HERE, THERE], render=Renderer())
    rows = torch.tensor([3, 0, 149])
    assert torch.equal(
        contributions(SCENE, [HERE, THERE], render=Renderer(), rows=rows), weights[rows]
    )
    assert contributions(SCENE, [], render=Renderer(), rows=rows).shape == (3, 0)
    assert contributions(
        SCENE.select(slice(0, 0)), [HERE, THERE], render=Renderer()
    ).shape == (0, 2)
    learnt = SCENE.replace(means=SCENE.means.clone().requires_grad_(True))
    with torch.no_grad():
        again = contributions(learnt, [HERE, THERE], render=Renderer())
    assert torch.equal(again, weights)
    assert not again.requires_grad
