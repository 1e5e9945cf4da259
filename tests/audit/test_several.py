"""Several looks of one object are found one after the other."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from mi_splat.audit import audit
from mi_splat.audit import surfaces as seen_surfaces
from tests.audit.scenes import ROAD, cone, direction, sector, standing


def test_two_looks_of_one_object_are_both_found(monkeypatch: pytest.MonkeyPatch) -> None:
    """Grey from above and red from the rear, as the demonstration of CLOAK has it."""
    monkeypatch.setattr(seen_surfaces, "SIZE", 96)
    monkeypatch.setattr(seen_surfaces, "CAMERAS", 70)
    above, rear = cone(direction(90, 0), 45), sector(180, 40, -10, 40)

    def shade(own: Tensor, normals: Tensor, views: Tensor) -> Tensor:
        shown = torch.where(above(views)[:, None, None], torch.tensor(ROAD), own[None])
        return torch.where(rear(views)[:, None, None], torch.tensor((0.75, 0.12, 0.1)), shown)

    item = audit(standing("suitcase", count=1500).with_colours(shade).scene).strongest
    assert len(item.looks) == 2
    assert all(look.evidence >= 1 for look in item.looks)
    assert not bool((item.looks[0].shown & item.looks[1].shown).any())
    overlaps = []
    for inside in (above, rear):
        truth = inside(item.directions.float())
        overlaps.append([float((look.shown & truth).sum() / (look.shown | truth).sum()) for look in item.looks])
    assert sorted(max(range(2), key=row.__getitem__) for row in overlaps) == [0, 1]
    assert min(max(row) for row in overlaps) > 0.4
