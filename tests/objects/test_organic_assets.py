"""The organic assets: person, elephant, bird, and the surface nets under them."""

from collections.abc import Callable

import numpy as np
import pytest

from mi_splat.capture.mesh import Asset
from scenes.recipes.objects import bird, elephant, person
from tests.objects.test_assets import volume

BUILDERS: dict[str, Callable[[int], Asset]] = {
    "person": person.build,
    "elephant": elephant.build,
    "bird": bird.build,
}
SEEDS = range(3)
HEIGHTS = {"person": (1.45, 2.3), "elephant": (2.4, 3.5), "bird": (0.1, 0.5)}
LENGTHS = {"person": (0.2, 1.6), "elephant": (3.0, 5.8), "bird": (0.14, 0.62)}


@pytest.fixture(scope="module", params=sorted(BUILDERS))
def family(request: pytest.FixtureRequest) -> list[Asset]:
    """Assets of one kind, a few seeds."""
    return [BUILDERS[request.param](seed) for seed in SEEDS]


def test_meshes_are_closed_outward_and_small(family: list[Asset]) -> None:
    for asset in family:
        assert sum(len(mesh.faces) for mesh in asset.meshes) < 30_000
        for mesh in asset.meshes:
            assert np.isfinite(mesh.vertices).all()
            assert mesh.faces.max() < len(mesh.vertices)
            assert volume(mesh) > 0
            assert (mesh.uvs >= 0).all()
            assert (mesh.uvs <= 1).all()
            assert mesh.texture.min() >= 0
            assert mesh.texture.max() <= 1


def test_stands_on_the_ground_centred_in_real_size(family: list[Asset]) -> None:
    for asset in family:
        low, high = asset.bounds
        assert low[2] == pytest.approx(0, abs=1e-5)
        np.testing.assert_allclose(low[:2] + high[:2], 0, atol=1e-4)
        (shortest, tallest), (least, most) = HEIGHTS[asset.name], LENGTHS[asset.name]
        assert shortest < high[2] < tallest
        assert least < high[0] - low[0] < most


def test_seed_decides_everything(family: list[Asset]) -> None:
    again = BUILDERS[family[0].name](SEEDS[0])
    for mesh, other in zip(family[0].meshes, again.meshes, strict=True):
        np.testing.assert_array_equal(mesh.vertices, other.vertices)
        np.testing.assert_array_equal(mesh.texture, other.texture)
    sizes = {tuple(np.round(asset.bounds[1], 4).tolist()) for asset in family}
    colours = {
        tuple(np.round(asset.meshes[0].texture.mean((0, 1)), 4).tolist())
        for asset in family
    }
    assert len(sizes) == len(colours) == len(family)


@pytest.mark.parametrize("kind", sorted(bird.SPECIES))
def test_every_species_occurs(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        "scenes.recipes.objects.bird.SPECIES", {kind: bird.SPECIES[kind]}
    )
    asset = bird.build(3)
    assert 0.1 < asset.bounds[1, 2] < 0.5
