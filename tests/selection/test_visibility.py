"""Weights of Gaussians and of objects in pictures, against the float64 oracle and against each other."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from mi_splat.cameras import RenderFn
from mi_splat.errors import InvalidValueError
from mi_splat.rendering import Renderer, RenderSettings
from mi_splat.scene import merge
from mi_splat.selection.visibility import contributions, object_maps, object_weight
from tests import oracle
from tests.rendering.test_rasterization import camera
from tests.rendering.test_specification import VIEW, blobs

SCENE, HERE, THERE = oracle.random_scene(150, degree=2, seed=5), camera(40, 31), camera(24, 24, azimuth=200.0)
GREY = RenderSettings(background=(0.3, 0.5, 0.7))


def test_contributions_are_the_oracles_weights(variant: str) -> None:
    boxes = [(5, 3, 30, 20), (7, 9, 8, 10)]
    whole = contributions(SCENE, [HERE, THERE], render=Renderer(GREY)).numpy()
    parts = contributions(SCENE, [HERE, THERE], render=Renderer(GREY), boxes=boxes).numpy()
    for number, view in enumerate((HERE, THERE)):
        x0, y0, x1, y1 = boxes[number]
        sums, in_box = np.zeros(len(SCENE)), np.zeros(len(SCENE))
        for i, _, weights, _ in oracle.blend(SCENE, view):
            sums[i], in_box[i] = weights.sum(), weights[y0:y1, x0:x1].sum()
        np.testing.assert_allclose(whole[:, number], sums, rtol=1e-5, atol=1e-5)
        np.testing.assert_allclose(parts[:, number], in_box, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("render", [Renderer(), Renderer(GREY), Renderer(RenderSettings(method="ray", alpha=True))])
def test_contributions_add_up_to_the_opacity(render: RenderFn, variant: str) -> None:
    method = render.settings.method if isinstance(render, Renderer) else "tile"
    alpha = Renderer(RenderSettings(method=method, alpha=True))(SCENE, HERE)[..., 3]
    found = contributions(SCENE, HERE, render=render)
    assert float(found.sum()) == pytest.approx(float(alpha.sum()), rel=1e-5)
    x, y = 20, 15
    pixel = contributions(SCENE, HERE, render=render, boxes=[(x, y, x + 1, y + 1)])
    assert float(pixel.sum()) == pytest.approx(float(alpha[y, x]), rel=1e-5)


def test_rows_and_gradients_of_the_scene_change_nothing(variant: str) -> None:
    found, rows = contributions(SCENE, [HERE, THERE], render=Renderer()), torch.tensor([3, 0, 149])
    assert torch.equal(contributions(SCENE, [HERE, THERE], render=Renderer(), rows=rows), found[rows])
    assert contributions(SCENE, [], render=Renderer(), rows=rows).shape == (3, 0)
    assert contributions(SCENE.select(slice(0, 0)), [HERE, THERE], render=Renderer()).shape == (0, 2)
    learnt = SCENE.replace(means=SCENE.means.clone().requires_grad_(True))
    with torch.no_grad():
        again = contributions(learnt, [HERE, THERE], render=Renderer())
    assert torch.equal(again, found)
    assert not again.requires_grad


@pytest.mark.parametrize("box", [(0, 0, 41, 31), (-1, 0, 3, 3), (3, 3, 3, 4), (3, 4, 4, 3)])
def test_bad_boxes(box: tuple[int, int, int, int]) -> None:
    with pytest.raises(InvalidValueError, match="box: expected x0 < x1 and y0 < y1 inside 40 x 31"):
        contributions(SCENE, HERE, render=Renderer(), boxes=[box])
    with pytest.raises(InvalidValueError, match="boxes: expected 1, one a camera, got 2"):
        contributions(SCENE, HERE, render=Renderer(), boxes=[box, box])


def test_two_objects_beside_each_other(variant: str) -> None:
    left, right = (blobs([2.0, 2.5], [0.9, 0.9], scale=0.1) for _ in range(2))
    shift = torch.tensor([0.6, 0.0, 0.0])
    scene = merge(left.replace(means=left.means - shift), right.replace(means=right.means + shift))
    maps = object_maps(scene, [slice(0, 2), slice(2, 4)], VIEW, render=Renderer(GREY))
    assert maps.weights.shape == (8, 8, 2)
    assert maps.ids[4, :4].tolist() == [0] * 4
    assert maps.ids[4, 5:].tolist() == [1] * 3
    assert maps.ids[0].tolist() == [-1] * 8
    one = object_maps(scene, [torch.tensor([False, False, True, True])], VIEW, render=Renderer())
    assert torch.equal(one.ids == 0, maps.ids == 1)


def test_weights_of_objects_add_up_to_the_opacity(variant: str) -> None:
    parts = [torch.arange(150) % 5 == k for k in range(5)]
    alpha = Renderer(RenderSettings(alpha=True))(SCENE, HERE)[..., 3]
    maps = object_maps(SCENE, parts, HERE, render=Renderer(GREY))
    torch.testing.assert_close(maps.weights.sum(-1), alpha, atol=2e-6, rtol=0)
    for number, rows in enumerate(parts):
        torch.testing.assert_close(
            maps.weights[..., number].clamp(0, 1), object_weight(SCENE, rows, HERE, Renderer()), atol=1e-6, rtol=0
        )
    assert torch.equal(maps.ids >= 0, alpha > 0)
    assert torch.equal(maps.ids[alpha > 0], maps.weights.argmax(-1)[alpha > 0])
    first = object_maps(SCENE, parts[:1], HERE, render=Renderer(GREY))
    lead = 2 * first.weights[..., 0] - alpha  # over all other Gaussians
    clear = lead.abs() > 1e-5
    assert torch.equal((first.ids == 0)[clear], (lead > 0)[clear])
    assert set(first.ids.flatten().tolist()) == {-1, 0}


def test_weights_of_objects_have_gradients(variant: str) -> None:
    opacities = SCENE.opacities.clone().requires_grad_(True)
    maps = object_maps(SCENE.replace(opacities=opacities), [slice(0, 75)], HERE, render=Renderer())
    maps.weights.sum().backward()  # type: ignore[no-untyped-call]
    assert opacities.grad is not None
    assert float(opacities.grad[:75].sum()) > 0 > float(opacities.grad[75:].sum())  # these hide what is behind them


def test_bad_objects() -> None:
    with pytest.raises(InvalidValueError, match="objects: expected at least one"):
        object_maps(SCENE, [], HERE, render=Renderer())
    with pytest.raises(InvalidValueError, match="got 10 of object 1 that belong to one before it"):
        object_maps(SCENE, [slice(0, 20), slice(10, 30)], HERE, render=Renderer())
