"""Splats of any size: of many Gaussians a few are linked, and only those in sight are rendered."""

from __future__ import annotations

import pytest
import torch

from mi_splat.audit import frames
from mi_splat.audit.frames import frame_of, targets
from mi_splat.audit.surfaces import cameras_around, in_sight
from mi_splat.scene import merge
from mi_splat.selection.neighbours import nearest_of
from tests.audit.scenes import Made, standing


@pytest.fixture(scope="module")
def suitcase() -> Made:
    return standing("suitcase", count=1500)


def test_each_point_goes_with_the_nearest_of_a_few() -> None:
    points = torch.rand(1000, 3, generator=torch.Generator().manual_seed(0))
    found = nearest_of(points, 4)
    few = torch.arange(0, 1000, 4)
    wanted = few[torch.cdist(points, points[few]).argmin(1)]
    assert bool((found % 4 == 0).all())
    assert torch.equal(found[few], few)
    assert float((found == wanted).double().mean()) > 0.7  # a leaf ends where it ends
    found_gaps, wanted_gaps = ((points - points[rows]).norm(dim=1) for rows in (found, wanted))
    assert float((found_gaps - wanted_gaps).max()) < 0.3
    assert torch.equal(nearest_of(points, 1), torch.arange(1000))


def test_objects_are_those_that_a_few_of_the_gaussians_show(suitcase: Made, monkeypatch: pytest.MonkeyPatch) -> None:
    scene = frame_of(suitcase.scene).scene
    (every,) = targets(scene)
    monkeypatch.setattr(frames, "MOST_LINKED", len(scene) // 3)
    (few,) = targets(scene)
    both = len(set(every.rows.tolist()) & set(few.rows.tolist()))
    assert both > 0.9 * max(len(every.rows), len(few.rows))
    assert few.radius == pytest.approx(every.radius, rel=0.06)
    assert torch.dist(few.centre, every.centre) < 0.06 * every.radius


def test_what_cannot_stand_before_an_object_is_not_rendered(suitcase: Made) -> None:
    scene = suitcase.scene
    (target,) = targets(frame_of(scene).scene)
    far = scene.replace(means=scene.means + torch.tensor([1000.0, 0.0, 0.0]))
    clear = scene.replace(opacities=torch.full((len(scene),), 1e-3))
    here = frame_of(scene).scene
    both = merge(here, far, clear)
    rows = in_sight(both, target, cameras_around(target))
    assert bool((rows < len(scene)).all())
    assert set(target.rows.tolist()) <= set(rows.tolist())
    huge = merge(here, far.replace(scales=torch.full((len(scene), 3), 400.0)))
    assert len(in_sight(huge, target, cameras_around(target))) == len(rows) + len(scene)
