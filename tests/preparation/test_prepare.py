"""Photographs and videos become sets that load: what was placed, what was not, and
errors that leave nothing behind.
"""

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from PIL import ExifTags, Image

from attacks import cli
from mi_splat.cameras.camera import Camera, look_at, orbit_pose
from mi_splat.cameras.lens import Lens
from mi_splat.datasets import PointCloud, load_dataset
from mi_splat.datasets.writing import list_colmap
from mi_splat.errors import MiSplatError
from mi_splat.maths.rotation import from_z
from mi_splat.preparation.config import PreparationError, PrepareConfig
from mi_splat.preparation.photographs import take_photographs
from mi_splat.preparation.prepare import in_child, not_placed, prepare
from mi_splat.preparation.worker import _trimmed, pairs_of, take_frames, up_of

OnProgress = Callable[[str, int, int], None]


def silent(text: str, done: int, total: int) -> None:
    """Progress that nobody hears of."""


def photographs(folder: Path, count: int, size: tuple[int, int] = (40, 30)) -> Path:
    """Noisy images, `IMG 0.png` and so on."""
    folder.mkdir()
    chance = np.random.default_rng(0)
    for number in range(count):
        pixels = chance.integers(0, 256, (size[1], size[0], 3)).astype(np.uint8)
        Image.fromarray(pixels).save(folder / f"IMG {number}.png")
    return folder


def all_but_the_last(
    what: str, task: Mapping[str, Any], on_progress: OnProgress
) -> dict[str, Any]:
    """Places all images but the last on a circle, in the place of COLMAP."""
    entries = []
    names = [name for name, _, _ in task["images"]]
    for number, (name, size, _) in enumerate(task["images"][:-1]):
        pose = orbit_pose((0, 0, 0), azimuth=10.0 * number, elevation=20, distance=3)
        entries.append((name, Camera(to_world=pose, lens=Lens(focal=50.0, size=size))))
    list_colmap(
        Path(task["root"]),
        {"train": entries},
        PointCloud(torch.zeros(5, 3), torch.zeros(5, 3)),
    )
    return {
        "models": [len(entries), 3],
        "error": 0.5,
        "points3D": 5,
        "features": dict.fromkeys(names, 7),
        "overlaps": dict.fromkeys(names[:-1], 2),
        "points": dict.fromkeys(names[:-1], 40),
        "made_by": "a circle",
    }


@pytest.fixture
def _on_a_circle(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("mi_splat.preparation.prepare.in_child", all_but_the_last)
    monkeypatch.setattr("mi_splat.preparation.prepare._check_colmap", lambda: None)


@pytest.mark.usefixtures("_on_a_circle")
def test_what_is_placed_is_a_set_and_the_rest_is_listed(tmp_path: Path) -> None:
    source = photographs(tmp_path / "photos", 11)
    (source / "IMG 4.png").write_bytes(b"no image")
    (source / "notes.txt").write_text("no image either")
    masks = photographs(tmp_path / "masks", 2)
    out = tmp_path / "set"
    record = prepare(source, out, PrepareConfig(), masks=masks, on_progress=silent)

    train, test = (load_dataset(out, split=split) for split in ("train", "test"))
    # every eighth
    assert [path.name for path in test.paths] == ["IMG_0.png", "IMG_8.png"]
    assert len(train) == 7
    original = np.asarray(Image.open(source / "IMG 1.png"), np.float32) / np.float32(
        255
    )
    np.testing.assert_array_equal(train[0].image.numpy(), original)
    assert [train.loss_mask(index) is not None for index in range(2)] == [True, False]

    assert record == json.loads((out / "prepare.json").read_text())
    assert [row["points"] for row in record["images"]] == [40] * 9 + [0]
    assert not_placed(record) == [
        "IMG 9.png (7 features, overlaps with 0 images)",
        f"IMG 4.png ({record['broken']['IMG 4.png']})",
    ]
    names = {path.name for path in (out / "images").iterdir()}
    assert names == {row["name"] for row in record["images"] if row["part"] != "none"}
    assert not list(tmp_path.glob(".*"))


def test_photographs_are_turned_shrunk_and_named_safely(tmp_path: Path) -> None:
    source = tmp_path / "photos"
    out = tmp_path / "out"
    source.mkdir()
    (out / "images").mkdir(parents=True)
    pixels = np.zeros((200, 400, 3), np.uint8)
    pixels[:, :200, 0] = 255
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = 6  # the top is at the right
    exif.get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.FocalLengthIn35mmFilm] = 26
    exif.get_ifd(ExifTags.IFD.GPSInfo)[ExifTags.GPS.GPSLatitudeRef] = "N"
    for name in ("a b\n.JPG", "a b_.jpg", "c.png"):
        Image.fromarray(pixels).save(source / name, exif=exif)
    (source / "masks").mkdir()
    # drawn on what the sensor saw
    Image.fromarray(pixels[..., 0]).save(source / "masks" / "a b_.png")
    # drawn on the upright image
    Image.fromarray(np.rot90(pixels[..., 0], -1)).save(source / "masks" / "c.png")
    config = PrepareConfig(longest_side=128)
    taken, broken = take_photographs(
        source, out, config, silent, masks=source / "masks"
    )
    assert broken == {}
    assert {photo.name for photo in taken} == {"a_b_.jpg", "a_b_-2.jpg", "c.png"}
    for photo in taken:
        assert photo.size == (64, 128)
        assert photo.focal == pytest.approx(26 * np.hypot(64, 128) / np.hypot(36, 24))
        with Image.open(out / "images" / photo.name) as written:
            # where the photograph was taken is nobody's business
            assert not written.getexif()
            red = np.asarray(written)[..., 0]
        assert red[:60].min() > 200
        assert red[70:].max() < 60
    masks = {
        path.name: np.asarray(Image.open(path)) for path in (out / "masks").iterdir()
    }
    assert set(masks) == {"a_b_-2.jpg.png", "c.png.png"}
    for mask in masks.values():
        assert mask.shape == (128, 64)
        assert mask[:60].min() > 250
        assert mask[70:].max() < 5


def write_video(path: Path, frames: list[np.ndarray]) -> None:
    import cv2

    height, width = frames[0].shape[:2]
    writer = cv2.VideoWriter(
        str(path), cv2.VideoWriter.fourcc(*"mp4v"), 10.0, (width, height)
    )
    for frame in frames:
        writer.write(frame)
    writer.release()


def test_a_video_gives_the_sharpest_frame_of_each_interval(tmp_path: Path) -> None:
    noise = np.random.default_rng(0).integers(0, 256, (6, 8, 3)).astype(np.uint8)
    frames = []
    for number in range(30):
        small = Image.fromarray(np.roll(noise, number, 1))
        is_sharp = number in (6, 12, 24)
        resampling = Image.Resampling.NEAREST if is_sharp else Image.Resampling.BICUBIC
        frames.append(np.asarray(small.resize((64, 48), resampling)))
    walk = tmp_path / "walk.mp4"
    images = tmp_path / "images"
    write_video(walk, frames)
    images.mkdir()
    taken = take_frames(walk, images, 128, 1.0, 300, silent)["images"]
    assert [frame["source"] for frame in taken] == ["0.6 s", "1.2 s", "2.4 s"]
    assert [frame["size"] for frame in taken] == [[64, 48]] * 3
    assert len(list(images.iterdir())) == 3
    assert len(take_frames(walk, images, 128, 0.1, 4, silent)["images"]) == 4


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"#EXTM3U\n/etc/passwd\n",
        b"ffconcat version 1.0\nfile /etc/passwd\n",
        b"\0\0\0\x18ftypmp42" + bytes(64),
    ],
    ids=["empty", "playlist", "list of files", "damaged"],
)
def test_what_is_no_video_is_refused_by_a_process_of_its_own(
    content: bytes, tmp_path: Path
) -> None:
    walk = tmp_path / "walk.mp4"
    walk.write_bytes(content)
    (tmp_path / "images").mkdir()
    task = {
        "kind": "frames",
        "root": str(tmp_path),
        "video": str(walk),
        "longest_side": 64,
        "interval": 1,
        "most": 9,
    }
    with pytest.raises(
        PreparationError, match=r"walk\.mp4: expected a video that FFmpeg can read"
    ):
        in_child(str(walk), task, silent)


def test_a_process_that_fails_is_said_in_one_line(tmp_path: Path) -> None:
    with pytest.raises(
        PreparationError,
        match=r"photos: expected a process that finishes, got it ended .*KeyError",
    ):
        in_child("photos", {"kind": "place", "root": str(tmp_path)}, silent)


class Model:
    """A model of COLMAP, as far as it is looked at, by how many points its images
    show.
    """

    def __init__(self, *points: int) -> None:
        self.images = {
            frame: SimpleNamespace(frame_id=frame, num_points3D=count, has_pose=True)
            for frame, count in enumerate(points)
        }

    def deregister_frame(self, frame: int) -> None:
        self.images[frame].has_pose = False

    def num_reg_images(self) -> int:
        return sum(image.has_pose for image in self.images.values())


def test_images_with_few_points_leave_their_models_and_small_models_go() -> None:
    empty = Model(5, 6, 7, 8, 9)
    most = Model(200, 40, 30, 29)
    few = Model(90, 90, 90, 90)
    assert _trimmed([empty, most, few]) == [few, most]
    assert (most.num_reg_images(), few.num_reg_images()) == (3, 4)


def test_many_images_are_not_all_matched_with_each_other() -> None:
    assert len(pairs_of(20, in_order=False)) == 190
    pairs = pairs_of(1000, in_order=True)
    assert len(pairs) < 12_000
    assert (0, 1) in pairs
    assert (0, 975) in pairs  # where the way comes back to


@pytest.mark.usefixtures("_on_a_circle")
@pytest.mark.parametrize(
    ("count", "says"),
    [
        (0, "at least 3 images .* got none"),
        (2, "at least 3 images .* got 2"),
        (9, "at most 8 images, got 9"),
        (4, "4 images that can be placed, got none"),
    ],
)
def test_sources_that_are_no_data_set_are_refused_and_leave_nothing(
    count: int, says: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    nothing: dict[str, Any] = {"models": [], "features": {}, "overlaps": {}}
    monkeypatch.setattr("mi_splat.preparation.prepare.in_child", lambda *_: nothing)
    source = photographs(tmp_path / "photos", count)
    out = tmp_path / "set"
    with pytest.raises(PreparationError, match=says):
        prepare(source, out, PrepareConfig(max_images=8), on_progress=silent)
    assert [path.name for path in tmp_path.iterdir()] == ["photos"]


@pytest.mark.usefixtures("_on_a_circle")
def test_only_a_prepared_set_is_replaced(tmp_path: Path) -> None:
    source = photographs(tmp_path / "photos", 5)
    out = tmp_path / "set"
    prepare(source, out, PrepareConfig(), on_progress=silent)
    with pytest.raises(MiSplatError, match="a new or an empty folder"):
        prepare(source, out, PrepareConfig(), on_progress=silent)
    prepare(source, out, PrepareConfig(), on_progress=silent, force=True)
    (tmp_path / "a.txt").write_text("")
    with pytest.raises(MiSplatError, match=r"\.mp4.*got \.txt"):
        prepare(tmp_path / "a.txt", tmp_path / "b", PrepareConfig(), on_progress=silent)


@pytest.mark.usefixtures("_on_a_circle")
def test_the_command_says_what_was_placed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    source = photographs(tmp_path / "photos", 10)
    assert cli.main(["prepare", str(source), "--out", str(tmp_path / "set")]) == 0
    captured = capsys.readouterr()
    assert "9 of 10 images placed: 7 for training, 2 held out" in captured.out
    assert "not placed: IMG 9.png (7 features" in captured.err
    assert "2 models, of 9, 3 images: the largest is taken" in captured.err
    own = [
        "prepare",
        str(tmp_path / "set" / "images"),
        "--out",
        str(tmp_path / "set"),
        "--force",
    ]
    assert cli.main(own) == 2
    assert "a folder without the input" in capsys.readouterr().err
    assert (tmp_path / "set" / "images" / "IMG_0.png").is_file()


def test_up_is_across_the_rights_of_cameras() -> None:
    chance = np.random.default_rng(1)
    up = torch.tensor([0.3, -0.8, 0.5], dtype=torch.float64)
    up /= up.norm()
    world = from_z(up)
    quarter = [  # from one side only, so that the mean of the cameras' ups leans
        look_at((3 * np.cos(a), 3 * np.sin(a), h), (0, 0, 0))[:3, :3]
        for a, h in zip(
            chance.uniform(0, 1.6, 20), chance.uniform(1, 4, 20), strict=True
        )
    ]
    turns = world @ torch.stack(quarter)
    assert float(up_of(turns.numpy()) @ up.numpy()) == pytest.approx(1.0, abs=1e-9)
    alike = world @ quarter[0].expand(4, 3, 3)
    np.testing.assert_allclose(up_of(alike.numpy()), -alike[0, :, 1])


@pytest.mark.usefixtures("_on_a_circle")
def test_images_of_many_kinds_are_refused_in_words(tmp_path: Path) -> None:
    source = photographs(tmp_path / "photos", 2)
    (source / "IMG_1.HEIC").write_bytes(b"\0\0\0\x18ftypheic" + bytes(20))
    with pytest.raises(
        PreparationError, match=r"IMG_1\.HEIC for instance: .*convert it"
    ):
        prepare(source, tmp_path / "set", PrepareConfig(), on_progress=silent)
