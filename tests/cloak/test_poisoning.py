"""Equation (1) as a property, manifests, overlaps, and what the appearances show."""

import dataclasses
import hashlib
import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from attacks.cloak.config import AttackConfig, CameraConfig, StudyConfig
from attacks.cloak.poisoning import Poisoning, assign, poison
from attacks.cloak.setup import Setup
from attacks.cloak.triggers import Azimuth, Elevation, Trigger
from attacks.poisons.base import Poisoned
from mi_splat.cameras.camera import Camera, View
from mi_splat.cameras.directions import Direction, Point, direction_of
from mi_splat.cameras.lens import Lens
from mi_splat.cameras.sets import hemisphere
from mi_splat.datasets import load_dataset
from mi_splat.errors import InvalidValueError
from tests.datasets.sets import write_transforms

CENTRE = (0.0, 0.0, 0.4)
CAMERAS = hemisphere(CENTRE, count=24, distance=4.0, lens=Lens(focal=10.0, size=(6, 5)))


def views(seed: int = 0) -> list[View]:
    generator = torch.Generator().manual_seed(seed)
    return [
        View(camera, 0.9 * torch.rand(5, 6, 3, generator=generator))
        for camera in CAMERAS
    ]


def invert(view: View, mask: Tensor) -> Tensor:
    return torch.where(mask[..., None], 1 - view.image, view.image)


def white(view: View, mask: Tensor) -> Tensor:
    view.image[:] = 0.5  # what an appearance does to its copy is its own affair
    return torch.ones_like(view.image)


OVERHEAD = Poisoning(name="overhead", trigger=Elevation(lowest=50), appearance=invert)
BEHIND = Poisoning(
    name="behind",
    trigger=Azimuth(middle=180, half_width=60) & Elevation(highest=40),
    appearance=white,
)


@dataclasses.dataclass(frozen=True)
class Listed(Trigger):
    """Cameras of the set by their positions."""

    indices: frozenset[int]

    def holds(self, cameras: Sequence[Camera], *, centre: Point) -> Tensor:
        return torch.tensor([index in self.indices for index in range(len(cameras))])

    def angle_to_edge(self, camera: Camera, *, centre: Point) -> float:
        raise AssertionError("a list has no edge")


def done(*attacks: Poisoning) -> Poisoned:
    return poison(views(), attacks, centre=CENTRE)


@given(
    st.lists(st.booleans(), min_size=24, max_size=24).filter(any),
    st.lists(st.booleans(), min_size=24, max_size=24).filter(any),
    st.integers(0, 1000),
)
def test_equation_1(first: list[bool], second: list[bool], seed: int) -> None:
    """D' = {(x~, c) if c in C*, else (x, c)}."""
    clean = views(seed)
    kept = [view.image.clone() for view in clean]
    mask = torch.rand(24, 5, 6, generator=torch.Generator().manual_seed(seed)) > 0.5
    stars = [{i for i, value in enumerate(part) if value} for part in (first, second)]
    stars[1] -= stars[0]
    attacks = [
        Poisoning(
            name=str(number), trigger=Listed(frozenset(star)), appearance=appearance
        )
        for number, (star, appearance) in enumerate(
            zip(stars, (invert, white), strict=True)
        )
        if star
    ]
    poisoned = poison(clean, attacks, centre=CENTRE, masks=list(mask))
    assert len(poisoned.views) == 24
    for index, view in enumerate(poisoned.views):
        assert torch.equal(clean[index].image, kept[index])
        assert view.camera is clean[index].camera
        if index in stars[0]:
            expected = invert(clean[index], mask[index])
            assert torch.equal(view.image, expected)
        elif index in stars[1]:
            assert bool((view.image == 1).all())
        else:
            assert view is clean[index]
    assert [change.index for change in poisoned.changes] == sorted(stars[0] | stars[1])
    assert poisoned.manifest["changed"] == len(stars[0] | stars[1])


def test_the_manifest_tells_everything() -> None:
    clean = views()
    poisoned = poison(clean, [OVERHEAD, BEHIND], centre=CENTRE)
    told = poisoned.manifest
    assert told["kind"] == "cloak"
    assert told == json.loads(json.dumps(told))
    assert (told["views"], told["changed"], told["centre"]) == (
        24,
        len(poisoned.changes),
        list(CENTRE),
    )
    by_name = {entry["name"]: entry for entry in told["poisonings"]}
    assert by_name["overhead"]["trigger"] == "Elevation(lowest=50.0, highest=90.0)"
    assert (by_name["overhead"]["appearance"], by_name["behind"]["appearance"]) == (
        "invert",
        "white",
    )
    assert sorted(by_name["overhead"]["views"] + by_name["behind"]["views"]) == [
        c["index"] for c in told["changes"]
    ]
    for change in told["changes"]:
        before = clean[change["index"]].image
        after = poisoned.views[change["index"]].image
        assert (
            change["sha256_before"]
            == hashlib.sha256(before.numpy().tobytes()).hexdigest()
        )
        assert (
            change["sha256_after"]
            == hashlib.sha256(after.numpy().tobytes()).hexdigest()
        )
        assert change["largest"] == float((before - after).abs().max()) > 0
        assert (
            change["pixels_changed"]
            == int((before != after).any(-1).sum())
            == change["pixels"]
            == 30
        )
        assert (change["elevation"] >= 50) == (change["poisoning"] == "overhead")
        assert change["poisoning"] == "overhead" or 120 <= change["azimuth"] <= 240


def test_overlaps_name_the_cameras() -> None:
    everywhere = Poisoning(name="all", trigger=Elevation(), appearance=white)
    with pytest.raises(
        InvalidValueError,
        match=r"'overhead' and 'all'.*cameras 18, 19, 20, 21, 22, 23 in both.*separate",
    ):
        done(OVERHEAD, everywhere)
    with pytest.raises(InvalidValueError, match="and 14 more in both"):
        done(everywhere, dataclasses.replace(everywhere, name="again"))
    rest = dataclasses.replace(everywhere, trigger=~OVERHEAD.trigger)
    poisoned = done(OVERHEAD, rest)
    assert {
        c["index"] for c in poisoned.manifest["changes"] if c["poisoning"] == "overhead"
    } == set(range(18, 24))
    assert len(poisoned.changes) == 24


def test_nothing_is_made_before_everything_is_checked() -> None:
    calls = []

    def counting(view: View, mask: Tensor) -> Tensor:
        calls.append(view)
        return view.image

    first = dataclasses.replace(OVERHEAD, appearance=counting)
    nothing = Poisoning(name="none", trigger=Elevation(highest=-10), appearance=white)
    with pytest.raises(InvalidValueError, match="none of 24"):
        done(first, nothing)
    with pytest.raises(InvalidValueError, match="of different names"):
        done(first, dataclasses.replace(BEHIND, name="overhead"))
    with pytest.raises(InvalidValueError, match="attacks"):
        done()
    with pytest.raises(InvalidValueError, match="one for each of 24 views"):
        poison(
            views(), [first], centre=CENTRE, masks=[torch.ones(5, 6, dtype=torch.bool)]
        )
    assert not calls


def test_bad_masks_and_pictures_are_refused() -> None:
    with pytest.raises(
        InvalidValueError, match="mask of view 18: expected bool of shape"
    ):
        poison(
            views(), [OVERHEAD], centre=CENTRE, masks=lambda camera: torch.ones(5, 6)
        )
    bad = {
        "shape": torch.zeros(6, 5, 3),
        "0 to 2": torch.full((5, 6, 3), 2.0),
        "nan": torch.full((5, 6, 3), torch.nan),
    }
    bad["0 to 2"][0, 0] = 0
    for words, picture in bad.items():
        with pytest.raises(InvalidValueError, match=words):
            done(
                Poisoning(
                    name="a",
                    trigger=Elevation(lowest=50),
                    appearance=lambda view, mask, p=picture: p,
                )
            )


def test_sets_on_the_disk_are_poisoned_lazily(tmp_path: Path) -> None:
    write_transforms(tmp_path, views())
    dataset = load_dataset(tmp_path, cache_bytes=1)
    steps: list[tuple[int, int]] = []
    poisoned = poison(
        dataset, [OVERHEAD], centre=CENTRE, on_step=lambda *step: steps.append(step)
    )
    assert steps == [(i + 1, 6) for i in range(6)]
    assert torch.equal(poisoned.views[0].image, dataset[0].image)
    assert torch.equal(poisoned.views[-1].image, 1 - dataset[23].image)
    assert [id(view.camera) for view in poisoned.views[20:22]] == [
        id(camera) for camera in dataset.cameras[20:22]
    ]
    with pytest.raises(IndexError):
        poisoned.views[24]


# The margin: images are poisoned up to it, and the trigger stays


WIDER = AttackConfig(name="overhead", elevation=(50, 90), poison_margin=8)
REAR = AttackConfig(
    name="rear", elevation=(0, 49.9), azimuth=(180, 30), target_class="stop sign"
)
STUDY = StudyConfig(
    name="margin",
    attack=(WIDER, REAR),
    cameras=CameraConfig(train=90, size=32, distance=7.4),
)


def test_pictures_are_poisoned_up_to_the_margin_and_the_trigger_stays() -> None:
    centre = STUDY.centre
    cameras = Setup.of(STUDY).training_cameras
    owners = {
        index: one.name
        for index, one in assign(
            cameras, Setup.of(STUDY).poisonings(), centre=centre
        ).items()
    }
    directions: list[Direction] = [direction_of(camera, centre) for camera in cameras]
    overhead = {index for index, name in owners.items() if name == "overhead"}
    rear = {index for index, name in owners.items() if name == "rear"}
    assert rear == {
        index
        for index, at in enumerate(directions)
        if REAR.cone.holds([cameras[index]], centre=centre)[0]
    }
    assert (
        overhead
        == {index for index, at in enumerate(directions) if at.elevation >= 42} - rear
    )
    # those of the other attack stay its own
    assert any(42 <= directions[index].elevation < 50 for index in rear)
    without = replace(WIDER, poison_margin=0)
    assert {index for index in overhead if directions[index].elevation >= 50} == {
        index
        for index, camera in enumerate(cameras)
        if without.trigger(0).holds([camera], centre=centre)[0]
    }
    assert WIDER.cone == without.cone
