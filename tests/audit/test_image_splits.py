"""Splits of made-up observations: two sides that share no point, gradual changes, and a
poison of two parts.
"""

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from mi_splat.audit import image_splits, images
from mi_splat.audit.image_files import summary_of
from mi_splat.audit.image_splits import Split, split_images
from mi_splat.audit.images import (
    CALLED,
    FEW,
    FEW_CALLED,
    ImageAudit,
    called_groups,
    is_called,
)
from mi_splat.audit.observations import Observations
from mi_splat.cameras.directions import unit_vector

RINGS = {20.0: 30, 42.0: 20}  # cameras at an elevation
POINTS = 120  # of each side
BRIGHTER = 0.12  # sRGB


def rings() -> tuple[Tensor, Tensor]:
    """(V, 3) directions of two rings of cameras, and (V,) which are of the upper."""
    directions = []
    upper = []
    for elevation, count in RINGS.items():
        for number in range(count):
            azimuth = (number + 0.5) * 360.0 / count
            directions.append(unit_vector(azimuth, elevation))
            upper.append(elevation > 30)
    return torch.tensor(directions), torch.tensor(upper)


def observed(directions: Tensor, brighter: Tensor) -> Observations:
    """Two sides, each seen by the cameras in front of it, and (V,) by how much an image
    shows them brighter than they are.
    """
    generator = torch.Generator().manual_seed(0)
    own = 0.3 + 0.3 * torch.rand(2 * POINTS, 3, generator=generator)
    noise = torch.randn(len(directions), 2 * POINTS, 3, generator=generator)
    is_front = (directions[:, :1] > 0).expand(-1, POINTS)
    return Observations(
        colours=own + brighter[:, None, None] + 0.01 * noise,
        seen=torch.cat([is_front, ~is_front], 1),
        directions=directions,
        separation=torch.cdist(directions, directions),
    )


def test_both_sides_of_a_sheet_are_matched_by_their_neighbours(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    directions, upper = rings()
    watched = observed(directions, BRIGHTER * upper.float())
    crossed = upper ^ (directions[:, 0] > 0)
    monkeypatch.setattr(image_splits, "_starts", lambda given: iter([crossed]))
    found = split_images(watched)
    assert found is not None
    assert torch.equal(found.smaller, upper)
    monkeypatch.setattr(image_splits, "_aligned", lambda watched, group, *_: group)
    unmatched = split_images(watched)
    assert unmatched is not None
    assert not torch.equal(unmatched.smaller, upper)


def test_a_gradual_change_has_no_strength() -> None:
    directions, _ = rings()
    azimuths = torch.atan2(directions[:, 1], directions[:, 0])
    found = split_images(observed(directions, 0.1 * azimuths.cos() / math.sqrt(2)))
    assert found is not None
    assert found.strength < CALLED


@pytest.mark.parametrize("poison", [0.0, 0.2])
def test_a_poison_is_found_beneath_a_gradual_change(poison: float) -> None:
    directions, upper = rings()
    azimuths = torch.atan2(directions[:, 1], directions[:, 0])
    poisoned = upper & (azimuths.abs() < 0.8)
    watched = observed(directions, 0.2 * azimuths.cos())
    watched.colours[poisoned, :60] += poison
    first = split_images(watched)
    assert first is not None
    assert not is_called(first)
    found = called_groups(watched)
    assert found is not None
    assert is_called(found) is (poison > 0)
    assert not poison or torch.equal(found.smaller, poisoned)


def test_a_poison_of_two_parts_is_found_in_two_rounds(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    directions, upper = rings()
    part = upper & (directions[:, 0] > 0)
    watched = observed(directions, BRIGHTER * upper.float())

    def found(given: Observations) -> Split | None:
        split = split_images(given)
        if split is None or given is not watched:
            return split
        return replace(split, smaller=part, decided=torch.ones_like(part))

    monkeypatch.setattr(images, "split_images", found)
    joined = called_groups(watched)
    assert joined is not None
    assert torch.equal(joined.smaller, upper)
    assert bool((joined.scores[upper] > 0).all())


def test_images_beside_poisoned_ones_that_remain_are_not_named_in_their_place(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    directions, upper = rings()
    part = upper & (directions[:, 0] > 0)
    watched = observed(directions, BRIGHTER * upper.float())
    remaining = upper[~part]
    beside = ~remaining & (torch.arange(len(remaining)) % 3 == 0)
    asked = []

    def found(given: Observations) -> Split | None:
        split = split_images(given)
        asked.append(len(given.seen))
        if split is None or len(given.seen) < len(remaining):
            return split
        decided = torch.ones(len(given.seen), dtype=torch.bool)
        if given is watched:
            return replace(split, smaller=part, decided=decided)
        # those that remain hesitate between the images beside them and all others
        scores = beside.float() - (~beside & ~remaining).float()
        return replace(split, smaller=beside, decided=decided, scores=scores)

    monkeypatch.setattr(images, "split_images", found)
    judged = called_groups(watched)
    assert judged is not None
    assert torch.equal(judged.smaller, part)
    assert asked == [len(upper), len(remaining), int((~remaining).sum())]


def test_a_weak_further_group_joins_nothing() -> None:
    directions, upper = rings()
    watched = observed(directions, BRIGHTER * upper.float())
    joined = called_groups(watched)
    assert joined is not None
    assert joined.strength > CALLED
    assert torch.equal(joined.smaller, upper)


def test_a_group_that_similar_splits_dispute_is_not_named() -> None:
    directions, upper = rings()
    part = upper & (directions[:, 0] > 0)
    best = split_images(observed(directions, BRIGHTER * upper.float()))
    assert best is not None
    disputed = image_splits._undisputed(
        best, [best, replace(best, smaller=part, decided=torch.ones_like(part))]
    )
    assert torch.equal(disputed.smaller, part)
    assert disputed.agreement == pytest.approx(0.5)
    judged = ImageAudit(count=len(upper), points=POINTS, split=disputed)
    assert judged.verdict == "not judged"
    assert not bool(judged.left_out("A").any())
    (said,) = summary_of(judged, [])
    assert "no image is named" in said
    weak = replace(best, smaller=part, edge=1.1)
    assert torch.equal(image_splits._chosen([best, weak]).smaller, upper)


def test_of_two_sides_the_one_that_fewer_images_are_sure_of_is_named() -> None:
    directions, upper = rings()
    best = split_images(observed(directions, BRIGHTER * upper.float()))
    assert best is not None
    few = ~upper & (directions[:, 0] > 0.7)
    assert 2 <= int(few.sum()) < 0.6 * int(upper.sum())
    turned = replace(best, smaller=few, decided=few | upper, edge=0.95 * best.edge)
    assert torch.equal(image_splits._chosen([best, turned]).smaller, few)
    weak = replace(turned, edge=1.1)
    assert torch.equal(image_splits._chosen([best, weak]).smaller, upper)


def test_images_that_nothing_links_to_a_compared_one_are_not_named() -> None:
    directions, upper = rings()
    watched = observed(directions, BRIGHTER * upper.float())
    compared = upper.nonzero()[:1, 0]
    reached = image_splits._reached(watched, upper, compared)
    assert torch.equal(reached, upper)
    part = upper & (directions[:, 0].abs() > 0.5)
    reached = image_splits._reached(watched, part, compared)
    assert torch.equal(reached, part & (directions[:, 0] > 0))


def test_the_place_of_an_image_is_judged_by_the_others_of_its_group() -> None:
    directions, upper = rings()
    watched = observed(directions, BRIGHTER * upper.float())
    noise = torch.full((2 * POINTS,), 0.01)
    places, _ = image_splits._places(watched, upper, noise)
    assert bool((places[upper] > 0.3).all())
    assert bool((places[~upper] < -0.3).all())
    stray = int(upper.nonzero()[0])
    alone = upper.clone()
    alone[stray] = False
    moved, _ = image_splits._places(watched, alone, noise)
    assert float(moved[stray]) == pytest.approx(float(places[stray]), abs=0.1)


def test_a_group_of_a_few_has_to_be_clearer() -> None:
    directions, upper = rings()
    split = split_images(observed(directions, BRIGHTER * upper.float()))
    assert split is not None
    few = torch.arange(len(upper)) < FEW - 1
    gain = split.gain * (CALLED + FEW_CALLED) / 2 / split.strength
    many = replace(split, gain=gain)
    assert is_called(many)
    assert not is_called(replace(many, smaller=few))
    assert is_called(replace(split, smaller=few))


def test_only_images_that_see_what_is_disputed_make_a_group_larger() -> None:
    directions, upper = rings()
    split = split_images(observed(directions, BRIGHTER * upper.float()))
    assert split is not None
    assert split.opposed == int((~upper).sum())

    few = torch.arange(len(upper)) < 5

    def is_equal(opposed: int | None, smaller: Tensor = few) -> bool:
        counted = replace(split, smaller=smaller, opposed=opposed)
        audit = ImageAudit(count=len(upper), points=POINTS, split=counted)
        return audit.is_nearly_equal

    assert not is_equal(None)
    assert not is_equal(2 * 5)
    assert is_equal(2 * 5 - 1)
    assert is_equal(2)
    assert not is_equal(2, upper)
