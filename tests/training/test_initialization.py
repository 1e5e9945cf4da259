"""Starting points."""

import pytest
import torch
import torch.nn.functional as functional
from torch import Tensor

from mi_splat.errors import InvalidValueError
from mi_splat.io.points import PointCloud
from mi_splat.maths.metrics import ssim as reported_ssim
from mi_splat.maths.sh import colour_to_dc
from mi_splat.training.initialization import (
    from_points,
    random_points,
    spacing,
    thinned,
    with_outliers,
)
from mi_splat.training.losses import photometric_loss
from tests.training.sets import views_of


def test_spacing_is_the_distance_to_the_nearest() -> None:
    grid = torch.cartesian_prod(*[torch.arange(4.0)] * 3)
    assert torch.allclose(spacing(grid), torch.ones(64))
    assert torch.allclose(
        spacing(1000 + 0.01 * grid), torch.full((64,), 0.01), rtol=0.02
    )
    assert spacing(grid[:1]).tolist() == [1.0]


def test_points_become_round_gaussians_of_their_colour() -> None:
    points = torch.rand(50, 3)
    colours = torch.rand(50, 3)
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
        torch.tensor([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0]]),
        torch.tensor([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]),
    )
    extended = with_outliers(cloud, views, 50, seed=3)
    assert torch.equal(extended.points[:2], cloud.points)
    assert torch.equal(extended.colours[:2], cloud.colours)
    eyes = torch.stack([view.camera.position for view in views]).float()
    for position, colour in zip(extended.points[2:], extended.colours[2:], strict=True):
        point = cloud.points[int(colour[1])]
        way = torch.linalg.norm(position - eyes, dim=1) / torch.linalg.norm(
            point - eyes, dim=1
        )
        rest = torch.linalg.norm(position - point) / torch.linalg.norm(
            point - eyes, dim=1
        )
        eye = int((way + rest).argmin())
        assert float(way[eye] + rest[eye]) == pytest.approx(1, abs=1e-5)
        assert 0.1 - 1e-5 <= float(way[eye]) <= 0.9 + 1e-5
    assert torch.equal(with_outliers(cloud, views, 50, seed=3).points, extended.points)
    assert not torch.equal(
        with_outliers(cloud, views, 50, seed=4).points, extended.points
    )
    assert torch.equal(with_outliers(cloud, views, 0).points, cloud.points)
    for count, around in ((-1, views), (1, [])):
        with pytest.raises(InvalidValueError, match="count, views and points"):
            with_outliers(cloud, around, count)


def test_a_thinned_cloud_keeps_its_order_and_colours() -> None:
    cloud = PointCloud(
        torch.arange(300.0).reshape(100, 3), torch.arange(300.0).reshape(100, 3) / 300
    )
    few = thinned(cloud, 40, seed=1)
    assert len(few.points) == 40
    assert (few.points[1:, 0] > few.points[:-1, 0]).all()
    assert torch.equal(few.colours, few.points / 300)
    assert torch.equal(few.points, thinned(cloud, 40, seed=1).points)
    assert not torch.equal(few.points, thinned(cloud, 40, seed=2).points)
    assert thinned(cloud, 100) is cloud


# The loss that training descends


def pictures(seed: int, height: int = 24, width: int = 30) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(seed)
    first = torch.rand(height, width, 3, generator=generator, dtype=torch.float64)
    return first, (
        first + 0.2 * torch.rand(first.shape, generator=generator, dtype=torch.float64)
    ).clamp(0, 1)


def ssim(image: Tensor, reference: Tensor) -> Tensor:
    return 1 - photometric_loss(image, reference, lambda_dssim=1)


def test_the_loss_has_its_derivative() -> None:
    image, reference = pictures(0, 13, 17)
    assert torch.autograd.gradcheck(
        lambda x: 3 * photometric_loss(x, reference), image.requires_grad_(True)
    )


def composed(image: Tensor, reference: Tensor) -> Tensor:
    """The loss from torch's operations, one after another, for autograd to
    differentiate.
    """
    taps = torch.exp(-0.5 * (torch.arange(-5, 6, dtype=image.dtype) / 1.5) ** 2)
    window = (torch.outer(taps, taps) / taps.sum() ** 2).expand(3, 1, 11, 11)
    x, y = (picture.permute(2, 0, 1) for picture in (image, reference))
    mx, my, xx, yy, xy = (
        functional.conv2d(planes, window, padding=5, groups=3)
        for planes in (x, y, x * x, y * y, x * y)
    )
    luminance = (2 * mx * my + 0.01**2) / (mx**2 + my**2 + 0.01**2)
    structure = (2 * (xy - mx * my) + 0.03**2) / (xx - mx**2 + yy - my**2 + 0.03**2)
    return 0.8 * (image - reference).abs().mean() + 0.2 * (
        1 - (luminance * structure).mean()
    )


@pytest.mark.parametrize("size", [(24, 32), (21, 25)])
def test_the_fast_loss_of_single_numbers_is_that_of_doubles_by_autograd(
    size: tuple[int, int],
) -> None:
    image, reference = pictures(6, *size)
    (truth,) = torch.autograd.grad(
        composed(image.requires_grad_(True), reference), image
    )
    single = image.detach().float().requires_grad_(True)
    loss = photometric_loss(single, reference.float())
    (gradient,) = torch.autograd.grad(loss, single)
    assert float(loss.detach()) == pytest.approx(
        float(composed(image.detach(), reference)), rel=1e-6
    )
    assert torch.allclose(
        gradient.double(), truth, rtol=0, atol=5e-6 * float(truth.abs().max())
    )
    before = torch.get_num_threads()
    torch.set_num_threads(1 if before > 1 else 2)
    assert torch.equal(
        torch.autograd.grad(photometric_loss(single, reference.float()), single)[0],
        gradient,
    )
    torch.set_num_threads(before)


def test_ssim_is_that_of_torchmetrics() -> None:
    from torchmetrics.functional.image import (
        structural_similarity_index_measure as theirs,
    )

    image, reference = (p.float() for p in pictures(1, 200, 200))
    first, second = (picture.permute(2, 0, 1)[None] for picture in (image, reference))
    expected = theirs(first, second, data_range=1.0)
    assert float(reported_ssim(image, reference)) == pytest.approx(
        float(expected),  # type: ignore[arg-type]
        abs=1e-6,
    )
    assert float(ssim(image, reference)) == pytest.approx(
        float(reported_ssim(image, reference)), abs=5e-3
    )
    assert float(ssim(image, image)) == pytest.approx(1.0, abs=1e-6)
