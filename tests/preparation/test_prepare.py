"""Photographs and videos become sets that load: what was placed, what was not, and errors that leave nothing behind."""

import itertools
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from PIL import ExifTags, Image

from attacks import cli
from mi_splat.cameras import Camera, look_at, orbit_pose
from mi_splat.datasets import PointCloud, load_dataset
from mi_splat.datasets.writing import list_colmap
from mi_splat.directions import up_of
from mi_splat.errors import MiSplatError
from mi_splat.io.images import save_animation
from mi_splat.preparation import pictures as video
from mi_splat.preparation.config import PreparationError, PrepareConfig
from mi_splat.preparation.pictures import Picture, take_frames, take_photographs
from mi_splat.preparation.prepare import SHEET, TILE, Reconstruction, _trimmed, not_placed, prepare
from mi_splat.rotation import from_z
from tests.project.layers import ROOT

OnProgress = Callable[[str, int, int], None]


def silent(text: str, done: int, total: int) -> None:
    """Progress that nobody hears of."""


def photographs(folder: Path, count: int, size: tuple[int, int] = (40, 30)) -> Path:
    """Noisy pictures, `IMG 0.png` and so on."""
    folder.mkdir()
    chance = np.random.default_rng(0)
    for number in range(count):
        pixels = chance.integers(0, 256, (size[1], size[0], 3)).astype(np.uint8)
        Image.fromarray(pixels).save(folder / f"IMG {number}.png")
    return folder


def all_but_the_last(
    root: Path, pictures: Sequence[Picture], in_order: bool, features: int, on_progress: OnProgress
) -> Reconstruction:
    """Places all pictures but the last on a circle."""
    entries = []
    for number, picture in enumerate(pictures[:-1]):
        pose = orbit_pose((0, 0, 0), azimuth=10.0 * number, elevation=20, distance=3)
        camera = Camera(to_world=pose, focal=50.0, width=picture.size[0], height=picture.size[1])
        entries.append((picture.name, camera))
    list_colmap(root, {"train": entries}, PointCloud(torch.zeros(5, 3), torch.zeros(5, 3)))
    names = [picture.name for picture in pictures]
    return Reconstruction(
        models=(len(entries), 3),
        features=dict.fromkeys(names, 7),
        overlaps=dict.fromkeys(names[:-1], 2),
        points=dict.fromkeys(names[:-1], 40),
    )


@pytest.fixture(autouse=True)
def _placed_without_colmap(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    if "nightly" not in request.keywords:
        monkeypatch.setattr("mi_splat.preparation.prepare.by_colmap", all_but_the_last)
        monkeypatch.setattr("mi_splat.preparation.prepare.check_colmap", lambda: None)


def test_what_is_placed_is_a_set_and_the_rest_is_listed(tmp_path: Path) -> None:
    source = photographs(tmp_path / "photos", 11)
    (source / "IMG 4.png").write_bytes(b"no picture")
    (source / "notes.txt").write_text("no picture either")
    out = tmp_path / "set"
    record = prepare(source, out, PrepareConfig(), on_progress=silent)

    train, test = (load_dataset(out, split=split) for split in ("train", "test"))
    assert [path.name for path in test.paths] == ["IMG_0.png", "IMG_8.png"]  # every eighth
    assert len(train) == 7
    assert torch.equal(train[0].image, load_dataset(out, split=None)[1].image)
    original = np.asarray(Image.open(source / "IMG 1.png"), np.float32) / np.float32(255)
    np.testing.assert_array_equal(train[0].image.numpy(), original)

    assert record == json.loads((out / "prepare.json").read_text())
    assert [row["points"] for row in record["pictures"]] == [40] * 9 + [0]
    assert not_placed(record) == [
        "IMG 9.png (7 features, overlaps with 0 pictures)",
        f"IMG 4.png ({record['broken']['IMG 4.png']})",
    ]
    names = {path.name for path in (out / "images").iterdir()}
    assert names == {row["name"] for row in record["pictures"] if row["part"] != "none"}
    assert not list(tmp_path.glob(".*"))

    sheet = np.asarray(Image.open(out / SHEET)).astype(int)
    frames = np.all(sheet == (192, 24, 24), -1).sum(0) > 2 * TILE[1] / 3  # columns in which a red frame stands
    assert frames.any()
    (left, right) = (int(np.flatnonzero(frames)[0]), int(np.flatnonzero(frames)[-1]))
    assert right - left == TILE[0] - 1  # one picture, the last
    inside = sheet[-TILE[1] : -40, left + 8 : right - 8]
    assert np.ptp(inside, axis=-1).max() == 0  # and it is grey


def test_photographs_are_turned_shrunk_and_named_safely(tmp_path: Path) -> None:
    source, images = tmp_path / "photos", tmp_path / "images"
    source.mkdir()
    images.mkdir()
    pixels = np.zeros((200, 400, 3), np.uint8)
    pixels[:, :200, 0] = 255
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = 6  # the top is at the right
    exif.get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.FocalLengthIn35mmFilm] = 26
    exif.get_ifd(ExifTags.IFD.GPSInfo)[ExifTags.GPS.GPSLatitudeRef] = "N"
    for name in ("a b\n.JPG", "a b_.jpg", "c.png"):
        Image.fromarray(pixels).save(source / name, exif=exif)
    taken, broken = take_photographs(source, images, PrepareConfig(longest_side=128), silent)
    assert broken == {}
    assert {picture.name for picture in taken} == {"a_b_.jpg", "a_b_-2.jpg", "c.png"}
    for picture in taken:
        assert picture.size == (64, 128)
        assert picture.focal == pytest.approx(26 * np.hypot(64, 128) / np.hypot(36, 24))
        with Image.open(images / picture.name) as written:
            assert not written.getexif()  # where the photograph was taken is nobody's business
            red = np.asarray(written)[..., 0]
        assert red[:60].min() > 200
        assert red[70:].max() < 60


def test_a_video_gives_the_sharpest_picture_of_each_interval(tmp_path: Path) -> None:
    pytest.importorskip("imageio_ffmpeg", reason="the extra video is not installed")
    noise = np.random.default_rng(0).integers(0, 256, (6, 8, 3)).astype(np.uint8)
    frames = []
    for number in range(30):
        small = Image.fromarray(np.roll(noise, number, 1))
        sharp = number in (7, 12, 25)
        frames.append(
            np.asarray(small.resize((64, 48), Image.Resampling.NEAREST if sharp else Image.Resampling.BICUBIC))
        )
    walk, images = tmp_path / "walk.mp4", tmp_path / "images"
    save_animation(frames, walk, fps=10)
    images.mkdir()
    config = PrepareConfig(longest_side=128)
    assert [picture.source for picture in take_frames(walk, images, config, silent)] == ["0.7 s", "1.2 s", "2.5 s"]
    assert len(list(images.iterdir())) == 3
    few = PrepareConfig(longest_side=128, interval=0.1, max_pictures=4)
    assert len(take_frames(walk, images, few, silent)) == 4
    with pytest.raises(PreparationError, match="at least 3 intervals, got 2"):
        take_frames(walk, images, PrepareConfig(interval=2), silent)
    walk.write_bytes(b"#EXTM3U\nhttp://127.0.0.1/a.ts\n")
    with pytest.raises(PreparationError, match="a video that ffmpeg can read"):
        take_frames(walk, images, config, silent)


def test_a_video_whose_last_picture_is_hours_later_ends(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    grey = np.zeros((4, 4, 3), np.uint8)
    still = itertools.chain([grey], itertools.repeat(None, 50_000))  # as ffmpeg fills the hours
    monkeypatch.setattr(video, "_decoded", lambda path, longest_side: still)
    monkeypatch.setattr(video, "_length", lambda path: 10.0)
    with pytest.raises(PreparationError, match="at most 1800 seconds"):
        take_frames(tmp_path / "walk.mp4", tmp_path, PrepareConfig(), silent)


class Model:
    """A model of COLMAP, as far as it is looked at, by how many points its pictures show."""

    def __init__(self, *points: int) -> None:
        self.images = {
            frame: SimpleNamespace(frame_id=frame, num_points3D=count, has_pose=True)
            for frame, count in enumerate(points)
        }

    def deregister_frame(self, frame: int) -> None:
        self.images[frame].has_pose = False

    def num_reg_images(self) -> int:
        return sum(image.has_pose for image in self.images.values())


def test_pictures_with_few_points_leave_their_models_and_small_models_go() -> None:
    empty, most, few = Model(5, 6, 7, 8, 9), Model(200, 40, 30, 29), Model(90, 90, 90, 90)
    assert _trimmed([empty, most, few]) == [few, most]
    assert (most.num_reg_images(), few.num_reg_images()) == (3, 4)


@pytest.mark.parametrize(
    ("count", "says"),
    [
        (0, "at least 3 pictures .* got none"),
        (2, "at least 3 pictures .* got 2"),
        (9, "at most 8 pictures, got 9"),
        (4, "4 pictures that can be placed, got none"),
    ],
)
def test_sources_that_are_no_data_set_are_refused_and_leave_nothing(
    count: int, says: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    nothing = Reconstruction(models=(), features={}, overlaps={})
    monkeypatch.setattr("mi_splat.preparation.prepare.by_colmap", lambda *_: nothing)
    source, out = photographs(tmp_path / "photos", count), tmp_path / "set"
    with pytest.raises(PreparationError, match=says):
        prepare(source, out, PrepareConfig(max_pictures=8), on_progress=silent)
    assert [path.name for path in tmp_path.iterdir()] == ["photos"]


def test_only_a_prepared_set_is_replaced(tmp_path: Path) -> None:
    source, out = photographs(tmp_path / "photos", 5), tmp_path / "set"
    prepare(source, out, PrepareConfig(), on_progress=silent)
    with pytest.raises(MiSplatError, match="a new or an empty folder"):
        prepare(source, out, PrepareConfig(), on_progress=silent)
    prepare(source, out, PrepareConfig(), on_progress=silent, force=True)
    (tmp_path / "a.txt").write_text("")
    with pytest.raises(MiSplatError, match=r"\.mp4.*got \.txt"):
        prepare(tmp_path / "a.txt", tmp_path / "b", PrepareConfig(), on_progress=silent)


def test_the_command_says_what_was_placed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source = photographs(tmp_path / "photos", 10)
    assert cli.main(["prepare", str(source), "--out", str(tmp_path / "set")]) == 0
    captured = capsys.readouterr()
    assert "9 of 10 pictures are placed: 7 for training, 2 held out" in captured.out
    assert "not placed: IMG 9.png (7 features" in captured.err
    assert "2 models, of 9, 3 pictures: the largest is taken" in captured.err
    own = ["prepare", str(tmp_path / "set" / "images"), "--out", str(tmp_path / "set"), "--force"]
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
        for a, h in zip(chance.uniform(0, 1.6, 20), chance.uniform(1, 4, 20), strict=True)
    ]
    turns = world @ torch.stack(quarter)
    assert float(up_of(turns) @ up) == pytest.approx(1.0, abs=1e-9)
    alike = world @ quarter[0].expand(4, 3, 3)
    assert torch.allclose(up_of(alike), -alike[0, :, 1])


@pytest.mark.nightly
def test_cameras_of_pictures_that_we_rendered_are_found(tmp_path: Path) -> None:
    """Within 0.2 degrees and 0.5 % of their distance from the middle, after the similarity that fits best."""
    pytest.importorskip("pycolmap", reason="pycolmap is not installed; pip install pycolmap")
    words = ["scenes/car_street.xml", "--cameras", "orbit:40@25", "--size", "1280x960"]
    renders, out = tmp_path / "renders", tmp_path / "set"
    assert cli.main(["render", *(str(ROOT / words[0]), *words[1:]), "--out", str(renders)]) == 0
    truth = {camera["name"]: camera["to_world"] for camera in json.loads((renders / "cameras.json").read_text())}
    assert cli.main(["prepare", str(renders), "--out", str(out)]) == 0
    dataset = load_dataset(out, split=None)
    assert len(dataset) == len(truth)
    wanted = torch.tensor([truth[path.stem] for path in dataset.paths], dtype=torch.float64)
    poses = torch.stack([camera.to_world for camera in dataset.cameras])
    (theirs, ours), middles = (poses[:, :3, 3], wanted[:, :3, 3]), (poses[:, :3, 3].mean(0), wanted[:, :3, 3].mean(0))
    left, values, right = torch.linalg.svd((ours - middles[1]).T @ (theirs - middles[0]))  # Umeyama, 1991
    turn = left @ torch.diag(torch.tensor([1, 1, torch.linalg.det(left @ right)], dtype=torch.float64)) @ right
    scale = values.sum() / (theirs - middles[0]).square().sum()
    radius = (ours - middles[1]).norm(dim=1).mean()
    off = (scale * (theirs - middles[0]) @ turn.T + middles[1] - ours).norm(dim=1)
    assert float(off.max() / radius) < 0.005
    cosines = ((turn @ poses[:, :3, :3] * wanted[:, :3, :3]).sum((1, 2)) - 1) / 2
    assert float(torch.rad2deg(torch.arccos(cosines.clamp(-1, 1))).max()) < 0.2
    assert float(turn[2, 2]) > np.cos(np.radians(0.2))  # z is up


def test_pictures_of_many_kinds_are_refused_in_words(tmp_path: Path) -> None:
    source = photographs(tmp_path / "photos", 2)
    (source / "IMG_1.HEIC").write_bytes(b"\0\0\0\x18ftypheic" + bytes(20))
    with pytest.raises(PreparationError, match=r"IMG_1\.HEIC for instance: .*convert it"):
        prepare(source, tmp_path / "set", PrepareConfig(), on_progress=silent)
