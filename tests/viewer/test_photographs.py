"""Data sets on a page: their cameras as they are, rolled ones too, and photographs
beside what a splat shows there.
"""

import json
import shlex
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from attacks import cli
from attacks.report.viewer_content import open_content
from mi_splat.cameras.camera import Camera, View, orbit_pose
from mi_splat.cameras.lens import Lens
from mi_splat.datasets import Dataset, DatasetWarning, load_dataset
from mi_splat.errors import InvalidValueError
from mi_splat.io import save_splat
from mi_splat.io.camera_records import describe
from mi_splat.io.images import to_bytes
from mi_splat.render.renderer import Renderer
from mi_splat.training.resume import poses_digest
from mi_splat.viewer.content import Photographs
from mi_splat.viewer.painter import Painter
from mi_splat.viewer.session import Pace, Step, ViewState
from tests.datasets.sets import write_colmap, write_transforms
from tests.fakes import blobs
from tests.gaussians import varied_scene

ROLLS = (0.0, 35.0, -120.0, 180.0, 90.0, 10.0)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory, variant: str) -> Path:
    """A splat and what was taken of it by rolled cameras, as transforms and as a model
    of COLMAP.
    """
    made = tmp_path_factory.mktemp("made")
    scene = varied_scene(60, degree=1, seed=4)
    render = Renderer()
    views = []
    for number, roll in enumerate(ROLLS):
        pose = orbit_pose(
            (0, 0, 0), azimuth=60.0 * number, elevation=20.0, distance=4.0, roll=roll
        )
        camera = Camera(
            to_world=pose,
            lens=Lens(
                focal=(60, 66), size=(48, 64 if number == 1 else 40), principal=(22, 18)
            ),
        )
        views.append(View(camera, render(scene, camera).clamp(0, 1)))
    write_transforms(made / "set", views[1:], test=views[:1])
    write_colmap(made / "colmap", views)
    save_splat(scene, made / "splat.ply")
    return made


@pytest.mark.parametrize("kind", ["set", "colmap"])
def test_a_set_alone_shows_what_its_cameras_took(folder: Path, kind: str) -> None:
    content = open_content(folder / kind)
    assert content.names == ("photograph",)
    assert len(content.cameras) == len(ROLLS)
    assert sum("held out" in name for name in content.cameras) == 1
    assert {round(orbit.roll) % 360 for orbit in content.cameras.values()} == {
        round(roll) % 360 for roll in ROLLS
    }
    work = Painter(content, blobs)
    with Image.open(next((folder / kind).rglob("*.png"))) as picture:
        photograph = np.asarray(picture.convert("RGB"))
    taken = [
        to_bytes(work.picture("photograph", orbit))
        for orbit in content.cameras.values()
    ]
    assert any(np.array_equal(pixels, photograph) for pixels in taken)
    assert {pixels.shape for pixels in taken} == {(40, 48, 3), (64, 48, 3)}
    assert "no photograph from here" in work.comparison(
        content.start.changed(azimuth=1.0)
    )


@pytest.mark.parametrize("kind", ["set", "colmap"])
def test_a_splat_is_rendered_where_each_photograph_was_taken(
    folder: Path, kind: str
) -> None:
    content = open_content(folder / "splat.ply", cameras=folder / kind)
    assert content.names == ("photograph", "splat")
    work = Painter(content, Renderer(content.settings))
    for orbit in list(content.cameras.values())[: len(ROLLS)]:
        assert (work.similarity(orbit) or 99.0) > 45  # the file of an image has 8 bits
    state = ViewState(orbit=content.start, mode="side by side", canvas=(96, 80))
    assert work.paint(state, Step.FULL, Pace()).pixels.std() > 10


def test_what_a_photograph_does_not_show_is_no_error(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    content = open_content(folder / "splat.ply", cameras=folder / "set")
    work = Painter(content, Renderer(content.settings))
    taken = work.picture("photograph", content.start)
    cut = taken.clone()
    cut[:, :20] = 0.0
    monkeypatch.setattr(Photographs, "from_camera", lambda self, name: cut)
    assert (work.similarity(content.start) or 99.0) < 30
    shown = (torch.arange(taken.shape[1]) >= 20).float().expand(taken.shape[:2])
    monkeypatch.setattr(Dataset, "loss_mask", lambda self, index: shown)
    assert (work.similarity(content.start) or 99.0) > 45


def test_the_command_makes_the_picture_of_a_rolled_camera(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    content = open_content(folder / "splat.ply", cameras=folder / "set")
    work = Painter(content, Renderer(content.settings))
    name = next(
        name for name, orbit in content.cameras.items() if round(orbit.roll) == 35
    )
    for orbit in (content.cameras[name], content.cameras[name].changed(azimuth=50.0)):
        command = shlex.split(work.commands(orbit)["splat"])
        assert ("--camera-roll" in command) == (orbit.exact is None)
        assert cli.main([*command[1:], "--out", "again.png", "--force"]) == 0
        with Image.open("again.png") as picture:
            assert np.array_equal(
                np.asarray(picture), to_bytes(work.picture("splat", orbit))
            )


def test_a_training_finds_its_set_and_how_it_was_rendered(
    folder: Path, tmp_path: Path
) -> None:
    run = tmp_path / "run"
    run.mkdir()
    shutil.copy(folder / "splat.ply", run)
    poses = poses_digest(load_dataset(folder / "set").cameras)
    recorded = {
        "settings": {"near": 0.3, "background": [1, 1, 1]},
        "dataset": str(folder / "set"),
        "poses": poses,
    }
    (run / "config.json").write_text(json.dumps(recorded))
    content = open_content(run)
    assert content.names == ("photograph", "run")
    assert (content.settings.near, content.settings.background) == (
        0.3,
        (1.0, 1.0, 1.0),
    )
    (tmp_path / "transforms.json").write_text("nobody's business")
    for change in (
        {"poses": "guessed"},
        *(
            {"dataset": path}
            for path in ("gone", 300 * "a", str(tmp_path), "//host/set")
        ),
    ):
        (run / "config.json").write_text(json.dumps({**recorded, **change}))
        content = open_content(run)
        assert content.names == ("run",)
        assert content.title.endswith(
            "the set of its training is not where it was: --cameras names it"
        )


def test_a_list_of_cameras_and_two_splats(folder: Path, tmp_path: Path) -> None:
    camera = next(iter(open_content(folder / "set").cameras.values())).exact
    assert camera is not None
    (tmp_path / "cameras.json").write_text(json.dumps([describe("here", camera)]))
    content = open_content(
        folder / "splat.ply",
        clean=folder / "splat.ply",
        cameras=tmp_path / "cameras.json",
    )
    assert list(content.cameras) == ["here", "whole scene"]
    assert torch.equal(content.start.camera((48, 40)).to_world, camera.to_world)
    assert (
        Painter(content, blobs).comparison(content.start)
        == "From here both images are the same."
    )
    beside = open_content(
        folder / "splat.ply", clean=folder / "splat.ply", cameras=folder / "set"
    )
    assert beside.names == ("clean", "attacked")


def test_a_splat_of_3dgs_opens_at_the_cameras_of_its_training(
    folder: Path, tmp_path: Path
) -> None:
    """As a room opens, whose cameras stand inside."""
    file = tmp_path / "point_cloud" / "iteration_7" / "point_cloud.ply"
    file.parent.mkdir(parents=True)
    shutil.copy(folder / "splat.ply", file)
    assert list(open_content(file).cameras) == ["whole scene"]
    inside = Camera(
        to_world=orbit_pose((0, 0, 0), azimuth=0, elevation=0, distance=0.1),
        lens=Lens(focal=30, size=(40, 30)),
    )
    (tmp_path / "cameras.json").write_text(json.dumps([describe("here", inside)]))
    assert torch.equal(
        open_content(file).start.camera((40, 30)).to_world, inside.to_world
    )


def test_what_cannot_be_shown_together(folder: Path) -> None:
    with pytest.raises(InvalidValueError, match="clean: expected nothing with a"):
        open_content(folder / "set", clean=folder / "splat.ply")
    with pytest.raises(
        InvalidValueError, match="cameras: expected none with a data set"
    ):
        open_content(folder / "set", cameras=folder / "colmap")
    with pytest.raises(
        InvalidValueError, match=r"cameras: expected a data set .* nothing there"
    ):
        open_content(folder / "splat.ply", cameras=folder / "none")


def test_poses_without_images_are_cameras(folder: Path, tmp_path: Path) -> None:
    poses = tmp_path / "transforms.json"
    path = tmp_path / "path.json"
    frames = [
        {"transform_matrix": torch.eye(4).tolist()},
        {"transform_matrix": torch.eye(4).tolist()},
    ]
    poses.write_text(
        json.dumps(
            {"camera_model": "FOV", "fl_x": 1e6, "w": 32, "h": 24, "frames": frames}
        )
    )
    with pytest.warns(DatasetWarning) as warned:
        content = open_content(folder / "splat.ply", cameras=poses)
    assert [str(line.message).partition(": ")[2][:30] for line in warned] == [
        "the poses are used without the",
        "2 of 2 cameras have a field of",
    ]
    assert {"transforms-0", "transforms-1"} <= set(content.cameras)
    assert content.photographs is None
    path.write_text(
        json.dumps(
            {"keyframes": [{"matrix": torch.eye(4).flatten().tolist(), "fov": 60}]}
        )
    )
    assert "path-0" in open_content(folder / "splat.ply", cameras=path).cameras
