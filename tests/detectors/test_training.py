from __future__ import annotations

import itertools
import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from torch import Tensor

from attacks.detectors.catalogue import SMALL_CLASSES
from attacks.detectors.training.augmentation import augment, blur, coarsen, like_a_splat, reframe, relight
from attacks.detectors.training.config import SPLITS, PictureSetConfig
from attacks.detectors.training.dataset import check_note, load, make, save_pictures
from attacks.detectors.training.pictures import LabelledPicture, SceneRenderer, random_scene, scene_pictures
from mi_splat.errors import InvalidValueError
from tests.detectors.made import drawn

pytestmark = pytest.mark.usefixtures("scalar")

TINY = PictureSetConfig(size=48, samples=1, shots=2, count=4)


@pytest.fixture(scope="module", autouse=True)
def _one_thread() -> None:
    torch.set_num_threads(1)


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


@pytest.mark.slow
def test_a_data_set_is_continued_and_read_back(tmp_path: Path) -> None:
    make(replace(TINY, count=2), tmp_path, processes=0)
    before = (tmp_path / "00000.png").stat().st_mtime_ns
    steps: list[tuple[int, int]] = []
    make(TINY, tmp_path, processes=0, on_step=lambda done, wanted: steps.append((done, wanted)))
    assert steps == [(4, 4)]
    assert (tmp_path / "00000.png").stat().st_mtime_ns == before
    samples = load(tmp_path)
    assert len(samples) == 4
    for ours, theirs in zip(samples, [*scene_pictures(TINY, 0), *scene_pictures(TINY, 1)], strict=True):
        assert torch.equal(ours.image, theirs.image)
        assert torch.equal(ours.boxes, theirs.boxes)
    assert json.loads((tmp_path / "labels.json").read_text())["recipe"]["count"] == 4


def test_kept_pictures_are_those_that_were_made(tmp_path: Path) -> None:
    save_pictures([drawn((10, 10, 30, 30)), drawn((20, 20, 40, 40))], tmp_path, {"made": "so"})
    assert len(load(tmp_path)) == 2
    second = tmp_path / "00001.png"
    made = second.read_bytes()
    Image.fromarray(255 - drawn((20, 20, 40, 40)).image.numpy()).save(second)
    with pytest.raises(InvalidValueError, match=r"00001\.png: .*got other bytes; delete the folder .* to have it made"):
        load(tmp_path)
    assert len(load(tmp_path, limit=1)) == 1
    second.unlink()
    with pytest.raises(InvalidValueError, match=r"00001\.png: .*got No such file"):
        load(tmp_path)
    second.write_bytes(made)
    assert len(load(tmp_path)) == 2


def test_a_set_without_digests_can_be_read(tmp_path: Path) -> None:
    save_pictures([drawn((10, 10, 30, 30))], tmp_path, {"made": "so"})
    content = json.loads((tmp_path / "labels.json").read_text())
    del content["pictures"]["00000.png"]["sha256"]
    (tmp_path / "labels.json").write_text(json.dumps(content))
    assert len(load(tmp_path)) == 1


def test_a_folder_of_another_configuration_is_left_alone(tmp_path: Path) -> None:
    make(replace(TINY, count=2), tmp_path, processes=0)
    with pytest.raises(InvalidValueError, match="choose an empty folder or the same configuration"):
        make(replace(TINY, seed=1), tmp_path, processes=0)
    with pytest.raises(InvalidValueError, match=r"expected a labels\.json, got none"):
        load(tmp_path / "nothing")


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


def test_renders_of_other_splats_are_refused(tmp_path: Path) -> None:
    sample = LabelledPicture(
        torch.zeros(8, 8, 3, dtype=torch.uint8), torch.zeros(0, 4), torch.zeros(0, dtype=torch.int64)
    )
    note: dict[str, object] = {"splats": {"views": 3, "rates": (1.0, 2.0)}}
    save_pictures([sample], tmp_path, note)
    check_note(tmp_path, note)
    check_note(tmp_path, {"splats": {"views": 3, "rates": (1.0, 2.0), "a later option": None}})
    with pytest.raises(InvalidValueError, match="choose an empty folder or the same configuration"):
        check_note(tmp_path, {"splats": {"views": 4, "rates": (1.0, 2.0)}})


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
    save_pictures([drawn((20, 30, 70, 80), label=1)], tmp_path, {"seed": 0})
    assert len(load(tmp_path)) == 1
    content = json.loads((tmp_path / "labels.json").read_text())
    (tmp_path / "labels.json").write_text(json.dumps({**content, "pictures": {"00000.png": record}}))
    with pytest.raises(
        InvalidValueError, match=r"labels\.json: 00000\.png: .*make the data set again|a list of objects"
    ):
        load(tmp_path)
