"""Poison-splat, its controls, and the filters of images against it, on splats of some
tens of Gaussians.
"""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from attacks.poisons.base import ImagePoison, Poisoned, ball, within_ball
from attacks.poisons.config import (
    FilterConfig,
    FrequencyPruningConfig,
    PoisonSplatConfig,
    RaisedVariationConfig,
    UniformNoiseConfig,
)
from attacks.poisons.defences import filtered, finest_samples, frequency_pruned
from attacks.poisons.poison_splat import (
    Decoy,
    PoisonSplat,
    RaisedVariation,
    UniformNoise,
    raised,
    total_variation,
)
from mi_splat.cameras.camera import View
from mi_splat.cameras.lens import Lens
from mi_splat.cameras.sets import orbit
from mi_splat.errors import InvalidValueError
from mi_splat.io.images import to_bytes
from mi_splat.render.renderer import Renderer, RenderSettings
from mi_splat.scene import GaussianScene
from mi_splat.training.config import FitConfig
from mi_splat.training.strategies import ClassicConfig
from tests.gaussians import varied_scene

CAMERAS = orbit(
    (0.0, 0.0, 0.0),
    count=6,
    elevation=20.0,
    distance=4.0,
    lens=Lens(focal=24.0, size=(20, 16)),
)
SPLAT = varied_scene(30, degree=1, seed=9)
SHORT = PoisonSplatConfig(steps=14, variation_steps=3, densify_every=5)
EAGER = FitConfig(strategy=ClassicConfig(densify_grad_threshold=1e-6))
FILTERS = [FilterConfig(name=name) for name in ("blur", "fourier", "wavelet")]


@pytest.fixture(scope="module")
def views() -> list[View]:
    """Images of 8 bits of the splat, a little unlike it."""
    render = Renderer(RenderSettings(near=0.1))
    with torch.no_grad():
        pictures = [render(SPLAT, camera).clamp(0, 1) for camera in CAMERAS]
    return [
        View(camera, (image * 240).round() / 255)
        for camera, image in zip(CAMERAS, pictures, strict=True)
    ]


def attack(
    config: PoisonSplatConfig = SHORT, start: GaussianScene = SPLAT, **more: Any
) -> PoisonSplat:
    return PoisonSplat(
        config=config, begun=Decoy(start=start, near=0.1, victim=EAGER, **more)
    )


POISONS: dict[str, ImagePoison] = {
    "decoy": attack(),
    "noise": UniformNoise(),
    "one by one": RaisedVariation(config=RaisedVariationConfig(variation_steps=3)),
}


def images(done: Poisoned) -> list[Tensor]:
    return [view.image for view in done.views]


@pytest.mark.parametrize("poison", POISONS.values(), ids=POISONS)
def test_pictures_change_within_the_ball_and_again_alike(
    poison: ImagePoison, views: list[View]
) -> None:
    heard: list[tuple[int, int]] = []
    done = poison(views, seed=3, on_step=lambda *at: heard.append(at))
    for view, image in zip(views, images(done), strict=True):
        steps = to_bytes(image).astype(int)
        # a file of 8 bits holds it exactly
        assert torch.equal(torch.from_numpy(steps / 255).float(), image)
        assert 0 < np.abs(steps - to_bytes(view.image)).max() <= 16
    assert heard[-1] == (len(heard), len(heard))
    again = poison(views, seed=3)
    other = poison(views, seed=4)
    assert done.manifest == again.manifest
    assert done.manifest["changed"] == len(views)
    if not isinstance(poison, RaisedVariation):  # nothing is drawn there
        assert [c.sha256_after for c in done.changes] != [
            c.sha256_after for c in other.changes
        ]


@pytest.mark.parametrize("nothing", [{"eps": 0}, {"share": 0.0}], ids=str)
def test_without_a_ball_or_a_share_the_very_views_come_back(
    nothing: dict[str, Any], views: list[View]
) -> None:
    poisons: list[ImagePoison] = [
        attack(replace(SHORT, **nothing)),
        UniformNoise(config=UniformNoiseConfig(**nothing)),
        RaisedVariation(config=RaisedVariationConfig(**nothing)),
    ]
    for poison in poisons:
        done = poison(views, seed=0)
        assert all(
            after is before for before, after in zip(views, done.views, strict=True)
        )
        assert done.changes == ()


def test_the_ball_holds_for_pictures_between_two_steps() -> None:
    clean = torch.linspace(0, 1, 300).reshape(10, 10, 3)
    for image in (torch.zeros_like(clean), torch.ones_like(clean)):
        steps = 255 * within_ball(image, clean, 2)
        assert float((steps - 255 * clean).abs().max()) <= 2 + 1e-3
        assert float((steps - steps.round()).abs().max()) < 1e-4
    assert torch.equal(
        within_ball(torch.ones_like(clean), clean, None), torch.ones_like(clean)
    )


def test_the_decoy_grows_up_to_its_limit(views: list[View]) -> None:
    assert len(attack().decoy(views, seed=0)) > len(SPLAT)
    assert (
        len(SPLAT)
        < len(attack(replace(SHORT, max_gaussians=33)).decoy(views, seed=0))
        <= 33
    )
    assert len(attack(replace(SHORT, densify_every=0)).decoy(views, seed=0)) == len(
        SPLAT
    )


def test_the_decoy_moves_at_every_so_many_cameras_only(views: list[View]) -> None:
    config = replace(SHORT, steps=3, densify_every=0, decoy_every=4)
    assert torch.equal(attack(config).decoy(views).means, SPLAT.means)
    assert not torch.equal(
        attack(replace(config, steps=4)).decoy(views).means, SPLAT.means
    )


def test_without_a_ball_the_pictures_are_the_decoys(views: list[View]) -> None:
    free = attack(replace(SHORT, eps=None))
    done = free(views, seed=0)
    decoy = free.decoy(views, seed=0)
    with torch.no_grad():
        render = Renderer(RenderSettings(near=0.1))
        for view, image in zip(views, images(done), strict=True):
            assert (
                float((render(decoy, view.camera).clamp(0, 1) - image).abs().max())
                <= 0.5 / 255 + 1e-6
            )


def test_total_variation_in_both_readings() -> None:
    image = torch.rand(
        5, 4, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64
    )
    columns, rows = (
        float(np.abs(np.diff(image.numpy(), axis=axis)).sum()) for axis in (0, 1)
    )
    assert float(total_variation(image)) == pytest.approx(rows + columns)
    assert float(total_variation(image, "vertical")) == pytest.approx(2 * columns)


def test_a_step_raises_what_it_is_asked_to_raise() -> None:
    clean = torch.full((6, 6, 3), 0.5)
    stripes = clean.clone()
    stripes[:, ::2] += 1 / 255  # varies along rows alone
    both = RaisedVariationConfig(eps=4, variation_steps=1)
    for config, distance in ((both, 5.0), (replace(both, variation="vertical"), 1.0)):
        steps = 255 * (raised(stripes, clean, config) - clean)
        assert float((steps[:, 2] - steps[:, 3]).mean()) == pytest.approx(
            distance, abs=1e-3
        )


@pytest.mark.parametrize("config", FILTERS, ids=[config.name for config in FILTERS])
def test_filters_keep_what_is_smooth_and_take_what_is_not(config: FilterConfig) -> None:
    flat = torch.tensor([0.2, 0.5, 0.9]).expand(9, 7, 3)
    assert torch.allclose(filtered(flat, config), flat, atol=1e-6)
    checked = 0.5 + 8 / 255 * (-1.0) ** (torch.arange(16)[:, None] + torch.arange(18))[
        ..., None
    ].expand(16, 18, 3)
    left = filtered(checked, config) - 0.5
    assert float(left[3:-3, 3:-3].abs().max()) < 1 / 255
    checked = checked.double().requires_grad_(True)
    torch.autograd.gradcheck(
        lambda image: filtered(image, config)[4:6, 4:6],
        checked[:8, :6].detach().requires_grad_(),
    )


def test_the_strength_of_a_filter() -> None:
    wave = 0.5 + 0.2 * torch.cos(torch.pi * (torch.arange(32) + 0.5) * 12 / 32)[
        :, None, None
    ].expand(32, 8, 3)
    kept, gone = (FilterConfig(name="fourier", strength=share) for share in (0.4, 0.35))
    # 12 of 32 half waves: a share of 0.375 of them
    assert torch.allclose(filtered(wave, kept), wave, atol=1e-5)
    assert torch.allclose(filtered(wave, gone), torch.full_like(wave, 0.5), atol=1e-5)


def test_an_attacker_looks_through_the_filter(views: list[View]) -> None:
    config = FilterConfig(name="blur")
    knows = RaisedVariation(config=RaisedVariationConfig(through=config))(views)
    not_knows = RaisedVariation()(views)
    left = [
        sum(float(total_variation(filtered(i, config))) for i in images(done))
        for done in (not_knows, knows)
    ]
    assert left[1] > 1.1 * left[0]
    assert (
        attack(replace(SHORT, steps=3, through=config))(views).manifest["through"][
            "name"
        ]
        == "blur"
    )


def test_what_cameras_cannot_sample_is_pruned(views: list[View]) -> None:
    fine = SPLAT.select(slice(0, 4)).replace(
        means=torch.tensor([[0.0, 0, 0], [0, 0, 0], [0, 0, 0], [0, 0, 99.0]])
    )
    pixel = float(finest_samples(fine, CAMERAS, near=0.1)[0])
    assert pixel == pytest.approx(4.0 / 24.0, rel=1e-5)
    needle = (0.1, 0.1, 9.0)
    thin = (0.3, 0.3, 0.3)
    flat = (0.01, 0.3, 0.3)
    unseen = (0.1, 0.1, 0.1)
    fine = fine.replace(scales=pixel * torch.tensor([needle, thin, flat, unseen]))
    kept = frequency_pruned(fine, views, FrequencyPruningConfig(samples=0.2), near=0.1)
    assert torch.equal(kept.scales, fine.scales[1:])
    with pytest.raises(InvalidValueError, match="lower samples"):
        frequency_pruned(
            fine.select(slice(0, 3)),
            views,
            FrequencyPruningConfig(samples=10.0),
            near=0.1,
        )


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: PoisonSplatConfig(eps=256), "eps: expected a number in"),
        (lambda: PoisonSplatConfig(share=1.5), "share"),
        (lambda: FilterConfig(name="fourier", strength=2.0), "strength of fourier"),
        (lambda: UniformNoise()([]), "views: expected at least one"),
    ],
)
def test_bad_input_is_refused(make: Any, words: str) -> None:
    with pytest.raises(InvalidValueError, match=words):
        make()


def test_a_start_that_is_not_of_these_views_is_refused(views: list[View]) -> None:
    elsewhere = SPLAT.replace(means=SPLAT.means + 1000.0)
    for start, words in (
        (elsewhere, "before some camera"),
        (SPLAT.select(slice(0, 0)), "at least one Gaussian"),
    ):
        with pytest.raises(InvalidValueError, match=words):
            attack(start=start)(views)
    with pytest.raises(InvalidValueError, match="finite"):
        attack(start=SPLAT.replace(means=SPLAT.means * torch.nan))(views)


def test_the_whole_ball_is_used() -> None:
    """What lies outside is clipped to the edge itself, and noise reaches it."""
    clean = torch.full((8, 8, 3), 0.5)
    for eps in (1, 8, 16):
        low, high = ball(clean, eps)
        assert torch.allclose(255 * (high - clean), torch.full_like(clean, eps))
        assert torch.allclose(255 * (clean - low), torch.full_like(clean, eps))
        on_grid = torch.full((8, 8, 3), 100 / 255)
        for image, sign in ((torch.ones_like(clean), 1), (torch.zeros_like(clean), -1)):
            change = 255 * (within_ball(image, on_grid, eps) - on_grid)
            assert torch.allclose(
                change, torch.full_like(clean, float(sign * eps)), atol=1e-3
            )
