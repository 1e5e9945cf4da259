"""Near planes: 3DGS's on usual scenes, and such on small ones that nothing of them is
lost.
"""

import pytest
import torch

from mi_splat.cameras.camera import Camera, look_at
from mi_splat.cameras.framing import REFERENCE_NEAR, bounds, culled_in_view, near_plane
from mi_splat.cameras.lens import Lens
from mi_splat.scene import GaussianScene, merge
from tests.gaussians import varied_scene


def looking_from(x: float, *, size: int = 32) -> Camera:
    return Camera(
        to_world=look_at((x, 0.0, 0.0), (0.0, 0.0, 0.0)),
        lens=Lens(focal=float(size), size=(size, size)),
    )


def scaled(scene: GaussianScene, factor: float) -> GaussianScene:
    """The scene, so many times its size, about the origin."""
    return scene.replace(means=factor * scene.means, scales=factor * scene.scales)


@pytest.fixture
def scene() -> GaussianScene:
    """A cloud of two world units' radius about the origin."""
    cloud = varied_scene(400, degree=0, seed=3)
    middle, radius = bounds(cloud)
    return scaled(cloud.replace(means=cloud.means - torch.tensor(middle)), 2.5 / radius)


def test_a_scene_of_usual_size_has_the_near_plane_of_3dgs(scene: GaussianScene) -> None:
    assert near_plane(scene) == REFERENCE_NEAR
    assert near_plane(scene, [looking_from(7.0)]) == REFERENCE_NEAR
    assert near_plane(scaled(scene, 1000.0), [looking_from(7000.0)]) == REFERENCE_NEAR


def test_near_shrinks_with_cameras_that_are_near(scene: GaussianScene) -> None:
    assert near_plane(scene, [looking_from(0.5)]) == pytest.approx(0.05, rel=0.05)
    _, radius = bounds(scene)
    assert near_plane(scene, [looking_from(1e-6)]) == pytest.approx(0.001 * radius)


def test_a_sky_is_not_looked_at(scene: GaussianScene) -> None:
    """A tenth of the Gaussians far away, as a captured sky is, is no part of what there
    is to look at.
    """
    far = 100 * torch.nn.functional.normalize(torch.randn(40, 3), dim=1)
    sky = scene.select(slice(0, 40)).replace(means=far)
    middle, radius = bounds(merge(scene, sky))
    half = float((scene.means - scene.means.median(dim=0).values).norm(dim=1).median())
    assert radius == pytest.approx(3 * half, rel=0.15)
    assert middle == pytest.approx((0.0, 0.0, 0.0), abs=0.3)
    assert bounds(scene)[1] == pytest.approx(2.5, rel=1e-5)


@pytest.mark.parametrize(
    ("beside", "inside"),
    [((0.0, 0.08), True), ((0.08, 0.0), True), ((0.0, 0.12), False)],
)
@pytest.mark.parametrize("sign", [-1, 1])
def test_only_what_is_in_the_picture_is_culled(
    beside: tuple[float, float], inside: bool, sign: int
) -> None:
    """At a depth of 0.2, the image is 0.2 wide and 0.2 high."""
    means = torch.tensor([[2.8, sign * beside[0], sign * beside[1]]])
    cloud = varied_scene(1, degree=0, seed=0)
    assert culled_in_view(cloud.replace(means=means), looking_from(3.0), 0.3) == int(
        inside
    )
    turned = torch.tensor([[2.8, sign * beside[1], sign * beside[0]]])
    assert culled_in_view(cloud.replace(means=turned), looking_from(3.0), 0.3) == int(
        inside
    )
