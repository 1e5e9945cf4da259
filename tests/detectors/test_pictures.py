"""Labelled pictures: functions of their configuration, kept whole on disk, changed at random for training."""

import itertools
import json
import math
from collections.abc import Sequence
from dataclasses import asdict, fields, replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from attacks.detectors.catalogue import SMALL_CLASSES, DetectorError
from attacks.detectors.training.augmentation import augment, blur, coarsen, like_a_splat, reframe, relight
from attacks.detectors.training.config import (
    BACKGROUNDS,
    SPLITS,
    BackgroundConfig,
    PictureSetConfig,
    SplatConfig,
    TrainingSetConfig,
)
from attacks.detectors.training.dataset import held_out_sets, made, training_sets, with_objects, without_objects
from attacks.detectors.training.pictures import (
    LabelledPicture,
    SceneRenderer,
    ViewingConditions,
    background_pictures,
    random_scene,
    scene_pictures,
    viewing_conditions,
)
from attacks.detectors.training.scenes import load, save
from mi_splat.assets.daylight import Light
from mi_splat.cameras import Camera, orbit_pose
from mi_splat.errors import InvalidValueError
from mi_splat.ledger import Job
from mi_splat.ledger.plans import Driver
from tests.detectors.made import drawn

pytestmark = pytest.mark.usefixtures("scalar")

TINY = PictureSetConfig(size=48, samples=1, shots=2, count=4)


def seeded(number: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(number)


# Pictures and data sets


def test_a_scene_is_a_function_of_the_configuration_and_its_number() -> None:
    first, second = random_scene(TINY, 5), random_scene(TINY, 5)
    assert [a.name for a in first.assets] == [a.name for a in second.assets]
    for one, other in zip((*first.assets, first.surroundings), (*second.assets, second.surroundings), strict=True):
        assert np.array_equal(one.vertices, other.vertices)
    assert (first.light.seed, first.light.sun_azimuth) == (second.light.seed, second.light.sun_azimuth)


def test_pictures_are_reproduced_to_the_bit() -> None:
    for one, other in zip(scene_pictures(TINY, 0), scene_pictures(TINY, 0), strict=True):
        assert torch.equal(one.image, other.image)
        assert torch.equal(one.boxes, other.boxes)
        assert torch.equal(one.labels, other.labels)


def test_splits_use_other_objects_and_lights() -> None:
    ranges = sorted(SPLITS.values())
    assert all(low < high for low, high in ranges)
    assert all(ours[1] <= theirs[0] for ours, theirs in itertools.pairwise(ranges))
    train, held_out = random_scene(TINY, 0), random_scene(replace(TINY, split="held-out"), 0)
    assert train.light.seed != held_out.light.seed


def test_an_unknown_split_is_refused() -> None:
    with pytest.raises(InvalidValueError, match="split: expected one of train, validation, held-out, got test"):
        PictureSetConfig(split="test")


@pytest.mark.slow
def test_cameras_reach_from_the_street_to_straight_down() -> None:
    renderer = SceneRenderer(replace(TINY, empty=1.0), 0)
    cameras = [renderer.choose_camera() for _ in range(120)]
    elevations = torch.tensor([math.degrees(math.asin(-float(c.to_world[2, 2]))) for c in cameras])
    counts = torch.histc(elevations, 6, 0, 90)
    assert float(counts.min()) > 9
    assert all(float(c.position[2]) > 0 for c in cameras)


def test_streets_have_objects_that_cameras_stand_near() -> None:
    renderer = SceneRenderer(replace(TINY, around="street", farthest=9.0, empty=0.0), 0)
    assert renderer.contents.surroundings.name == "street"
    centre = torch.from_numpy(renderer.contents.assets[0].body.vertices.mean(0))
    cameras = [renderer.choose_camera() for _ in range(6)]
    assert all(float((camera.position - centre).norm()) < 11 for camera in cameras)
    with pytest.raises(InvalidValueError, match=r"one of street, park, .*got beach"):
        replace(TINY, around="beach")


def test_boxes_are_tight_and_inside_the_picture() -> None:
    for sample in scene_pictures(replace(TINY, size=64, empty=0.0, street=0.0), 3):
        assert SMALL_CLASSES[int(sample.labels[0]) - 1] == SMALL_CLASSES[3]
        low, high = sample.boxes[:, :2], sample.boxes[:, 2:]
        assert bool(((low >= 0) & (high <= 64) & (high > low)).all())


def made_of(jobs: Sequence[Job], folder: Path) -> tuple[list[LabelledPicture], list[tuple[int, int]]]:
    """The pictures of jobs, and how it went on."""
    steps: list[tuple[int, int]] = []
    sets = made(folder, {"x": jobs}, processes=0, on_work=lambda text, done, total: steps.append((done, total)))
    return sets["x"], steps


@pytest.mark.slow
def test_a_data_set_is_continued_and_read_back(tmp_path: Path) -> None:
    made_of(with_objects(replace(TINY, count=2)), tmp_path)
    times = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*.png")}
    samples, steps = made_of(with_objects(replace(TINY, count=3)), tmp_path)
    assert steps == [(1, 2), (2, 2)]
    assert len(times) == 2
    assert times == {path: path.stat().st_mtime_ns for path in times}
    for ours, theirs in zip(samples, [*scene_pictures(TINY, 0), *scene_pictures(TINY, 1)], strict=True):
        assert torch.equal(ours.image, theirs.image)
        assert torch.equal(ours.boxes, theirs.boxes)
        assert ours.conditions == theirs.conditions
    others, _ = made_of(with_objects(replace(TINY, seed=1, count=2)), tmp_path)
    assert not torch.equal(others[0].image, samples[0].image), "another configuration is another job"


def test_kept_pictures_are_those_that_were_made(tmp_path: Path) -> None:
    jobs = without_objects(NOTHING, "ground")
    made_of(jobs, tmp_path)
    second = next(tmp_path.rglob("00001.png"))
    kept = second.read_bytes()
    second.write_bytes(kept[:-1])
    with pytest.raises(InvalidValueError, match=r"expected the files that it wrote, got another 00001\.png"):
        made_of(jobs, tmp_path)
    second.write_bytes(kept)
    assert len(made_of(jobs, tmp_path)[0]) == 2


def test_pictures_that_cannot_be_made_are_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Driver, "run", lambda self, plans: {"x 0": "Traceback\nValueError: no light"})
    with pytest.raises(DetectorError, match="scene 0 of x: expected its pictures, got ValueError: no light"):
        made_of(without_objects(NOTHING, "ground"), tmp_path)


NOTHING = BackgroundConfig(scenes=1, shots=2, samples=1, size=32)


@pytest.mark.parametrize(
    "record",
    [
        7,
        {"boxes": [[0, 0, 1, 1]], "labels": []},
        {"boxes": [[0, 0, 1]], "labels": [1]},
        {"boxes": [[0, 0, 1, "x"]], "labels": [1]},
        {"boxes": [[0, 0, 1, 1]], "labels": [99]},
        {"boxes": [[0, 0, 1, 1]], "labels": [1], "conditions": [{"elevation": "low"}]},
    ],
)
def test_broken_labels_are_refused(record: object, tmp_path: Path) -> None:
    save([drawn((20, 30, 70, 80), label=1)], tmp_path)
    assert len(load(tmp_path)) == 1
    content = json.loads((tmp_path / "labels.json").read_text())
    if isinstance(record, dict):
        record = {**content["00000.png"], **record}
    (tmp_path / "labels.json").write_text(json.dumps({"00000.png": record}))
    with pytest.raises(InvalidValueError, match=r"labels\.json: 00000\.png: .*make them again|a list of objects"):
        load(tmp_path)


# Pictures without objects


@pytest.mark.parametrize("kind", BACKGROUNDS)
def test_backgrounds_have_no_object_and_are_reproduced(kind: str) -> None:
    first, again = (background_pictures(kind, 0, NOTHING) for _ in range(2))
    assert len(first) == 2
    assert all(len(one.labels) == len(one.boxes) == 0 for one in first)
    assert all(torch.equal(one.image, other.image) for one, other in zip(first, again, strict=True))
    assert float(first[0].image.float().std()) > 1
    assert not torch.equal(first[0].image, background_pictures(kind, 1, NOTHING)[0].image)


def test_a_kind_that_there_is_not_is_refused() -> None:
    with pytest.raises(InvalidValueError, match=r"one of street, park, .*got beach"):
        background_pictures("beach", 0, NOTHING)


# How objects are seen


ONE_OBJECT = PictureSetConfig(split="held-out", size=48, samples=1, shots=2, count=2, empty=0.0, pair=0.0, street=0.0)
FEW = SplatConfig(views=2, samples=1, objects=300, surroundings=300, sky=50, steps=0, pictures=2)
CORNERS = np.array([[-1.0, -2.0, 0.0], [1.0, 2.0, 4.0], [0.0, 0.0, 1.0]], np.float32)


def from_elevation(degrees: float) -> Camera:
    pose = orbit_pose((0.0, 0.0, 2.0), azimuth=70.0, elevation=degrees, distance=9.0)
    return Camera(to_world=pose, focal=50.0, width=64, height=64)


@pytest.mark.parametrize("elevation", [0.0, 33.0, 90.0])
def test_a_case_done_by_hand(elevation: float) -> None:
    light = Light(sun_elevation=31.0, sun_strength=1.5)
    seen = viewing_conditions(CORNERS, from_elevation(elevation), light)
    assert seen.elevation == pytest.approx(elevation, abs=1e-4)
    assert seen.distance == pytest.approx(9.0, abs=1e-5)
    assert seen.extent == pytest.approx(math.sqrt(4 + 16 + 16), abs=1e-5)
    assert (seen.sun_elevation, seen.sun_strength) == (31.0, 1.5)
    assert viewing_conditions(CORNERS, from_elevation(0.0)).sun_elevation is None


def test_they_are_recorded_with_the_pictures(tmp_path: Path) -> None:
    save(scene_pictures(ONE_OBJECT, 0), tmp_path)
    samples = load(tmp_path)
    assert all(len(one.conditions) == len(one.labels) > 0 for one in samples)
    renderer = SceneRenderer(ONE_OBJECT, 0)
    light, cameras = renderer.contents.light, [renderer.choose_camera() for _ in range(ONE_OBJECT.shots)]
    for sample, camera in zip(samples, cameras, strict=True):
        assert {seen.sun_elevation for seen in sample.conditions} == {round(light.sun_elevation, 6)}
        down = math.degrees(math.asin(-float(camera.to_world[2, 2])))  # it looks at the one object there is
        assert [seen.elevation for seen in sample.conditions] == pytest.approx([down], abs=1e-4)


def test_values_of_other_kinds_are_not_lost() -> None:
    seen = ViewingConditions(elevation=1.0, distance=2.0, extent=3.0)
    assert ViewingConditions(**json.loads(json.dumps(asdict(seen)))) == seen


@pytest.mark.slow
def test_held_out_sets_say_how_objects_are_seen(tmp_path: Path) -> None:
    jobs = held_out_sets(ONE_OBJECT, splats=1, splat=FEW, backgrounds=BackgroundConfig(scenes=0))
    sets = made(tmp_path, jobs, processes=1, on_work=lambda *_: None)
    assert {name: len(pictures) for name, pictures in sets.items()} == {"path traced": 2, "splat renders": 2}
    for pictures in sets.values():
        assert all(len(sample.conditions) == len(sample.labels) for sample in pictures)
        assert any(sample.conditions for sample in pictures)


def test_training_sets_have_the_pictures_that_are_asked_for() -> None:
    none = {field.name: 0 for field in fields(TrainingSetConfig)}
    counts = TrainingSetConfig(**{**none, "validation": 4, "splats": 2, "backgrounds": 1, "pictures": 7})
    pictures, validation = ([job.config for job in jobs] for jobs in training_sets(counts))
    assert [config.number for config in validation] == [0, 1]
    assert {config.scenes.split for config in validation} == {"validation"}
    kinds = ["", "", "", "", "", *BACKGROUNDS, "street", "street", "street"]
    assert [config.kind for config in pictures] == kinds
    assert [config.splat is None for config in pictures] == [*[True] * 3, False, False, *[True] * 8]
    assert len({job.identity for jobs in training_sets(TrainingSetConfig()) for job in jobs}) == sum(
        map(len, training_sets(TrainingSetConfig()))
    ), "no picture is there twice"


# Augmentation


def bounds(image: Tensor) -> Tensor:
    """(4,) box around the bright red pixels of a (3, H, W) picture."""
    rows, columns = torch.where((image[0] > 0.6) & (image[2] < 0.2))
    return torch.stack([columns.min(), rows.min(), columns.max() + 1, rows.max() + 1]).float()


@pytest.mark.parametrize("seed", range(6))
def test_boxes_follow_the_picture_when_it_is_reframed(seed: int) -> None:
    sample = drawn((30, 40, 60, 62))
    image = sample.image.permute(2, 0, 1).float() / 255
    moved, boxes, labels = reframe(image, sample.boxes, sample.labels, seeded(seed))
    assert labels.tolist() == [1]
    assert float((bounds(moved) - boxes[0]).abs().max()) < 1.6


def test_objects_that_leave_the_frame_lose_their_box() -> None:
    sample = drawn((0, 0, 10, 10))
    image = sample.image.permute(2, 0, 1).float() / 255
    kept = [len(reframe(image, sample.boxes, sample.labels, seeded(i))[1]) for i in range(40)]
    assert 0 < sum(kept) < 40


@pytest.mark.parametrize("seed", range(8))
def test_augmented_pictures_are_8_bit_and_reproducible(seed: int) -> None:
    sample = drawn((30, 40, 60, 62))
    image, boxes, _ = augment(sample, seeded(seed))
    again, same, _ = augment(sample, seeded(seed))
    assert torch.equal(image, again)
    assert torch.equal(boxes, same)
    assert image.shape == (3, 96, 96)
    torch.testing.assert_close((image * 255).round() / 255, image)
    assert float(image.min()) >= 0
    assert float(image.max()) <= 1


def test_softening_keeps_a_plain_picture_plain() -> None:
    plain = torch.full((3, 40, 56), 0.3)
    torch.testing.assert_close(blur(plain, 1.3), plain)
    torch.testing.assert_close(coarsen(plain, 2.2), plain)
    assert like_a_splat(plain, seeded()).shape == plain.shape
    assert torch.isfinite(relight(plain, seeded())).all()
