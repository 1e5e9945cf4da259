"""Captures that are written as they go: the same bytes after any interruption, point
clouds, refusals.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from mi_splat.cameras.camera import Camera, look_at
from mi_splat.cameras.lens import Lens
from mi_splat.cameras.sets import hemisphere, orbit
from mi_splat.capture.daylight import Light
from mi_splat.capture.mesh import Asset
from mi_splat.capture.mitsuba_scene import scene_dict
from mi_splat.capture.path_tracer import PathTracer
from mi_splat.capture.settings import CaptureSettings
from mi_splat.capture.sources import CaptureSource
from mi_splat.capture.surface_points import surface_points
from mi_splat.capture.writer import write_capture
from mi_splat.datasets import load_dataset
from mi_splat.errors import InvalidValueError
from scenes.recipes.mesh_views import capture
from scenes.recipes.objects.primitives import box, quad

RED = (0.8, 0.1, 0.1)
GREEN = (0.1, 0.7, 0.1)


CUBE = Asset("cube", (box((1, 1, 1), RED, centre=(0, 0, 0.5)),))
FLOOR = Asset("floor", (quad([[-4, -4, 0], [4, -4, 0], [4, 4, 0], [-4, 4, 0]], GREEN),))
EVEN = Light(
    sun_strength=0.0, sky_strength=1.0, zenith=(1, 1, 1), horizon=(1, 1, 1), clouds=0.0
)
QUICK = CaptureSettings(samples=2, points=300)


def source(*assets: Asset) -> CaptureSource:
    first, *others = assets
    scene = scene_dict([first], light=EVEN, backdrop=others[0] if others else None)
    return CaptureSource(
        scene=scene,
        centre=(0, 0, 0.5),
        radius=0.9,
        assets=assets,
        digest=f"{len(assets)}",
    )


def cameras(count: int = 4, **change: Any) -> list[Camera]:
    lens = Lens(focal=18.0, size=(16, 16))
    values = {"distance": 3.0, "lens": lens, "elevation": 30.0, **change}
    return orbit((0, 0, 0.5), count=count, **values)


def contents(folder: Path) -> dict[str, bytes]:
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file()
    }


@pytest.mark.parametrize("layout", ["transforms", "colmap", "both"])
def test_a_capture_is_a_set(layout: Any, tmp_path: Path) -> None:
    seen: list[tuple[int, int]] = []
    test = cameras(2, start=45.0)
    done = write_capture(
        source(CUBE),
        cameras(),
        tmp_path / "set",
        test=test,
        settings=QUICK,
        layout=layout,
        on_step=lambda number, total: seen.append((number, total)),
    )
    assert (done.train, done.test, done.rendered) == (4, 2, 6)
    assert seen == [(i, 6) for i in range(1, 7)]
    assert all(file.is_file() for file in done.files)
    taken = capture(source(CUBE).scene, [*cameras(), *test], samples=2)
    for split, part in (("train", taken[:4]), ("test", taken[4:])):
        dataset = load_dataset(tmp_path / "set", split=split)  # type: ignore[arg-type]
        for ours, theirs in zip(dataset, part, strict=True):
            assert (ours.image - theirs.image).abs().max() <= 0.5 / 255 + 1e-6
            torch.testing.assert_close(
                ours.camera.to_world, theirs.camera.to_world, atol=1e-6, rtol=0
            )
        assert dataset.points is not None
        assert len(dataset.points) == done.points


def test_a_capture_goes_on_where_it_stopped(tmp_path: Path) -> None:
    words: dict[str, Any] = {
        "test": cameras(1, start=45.0),
        "settings": QUICK,
        "layout": "both",
    }
    write_capture(source(CUBE), cameras(), tmp_path / "whole", **words)
    wanted = contents(tmp_path / "whole")
    folder = tmp_path / "stopped"

    def stop(number: int, total: int) -> None:
        if number == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_capture(source(CUBE), cameras(), folder, on_step=stop, **words)
    assert len(list((folder / "images").iterdir())) == 3
    assert not (folder / "transforms_train.json").exists()
    assert write_capture(source(CUBE), cameras(), folder, **words).rendered == 2
    assert contents(folder) == wanted
    # Whatever is lost or broken afterwards comes back with the same bytes.
    (folder / "images" / "train_00001.png").unlink()
    (folder / "images" / "test_00000.png").write_bytes(
        wanted["images/test_00000.png"][:60]
    )
    (folder / "sparse" / "0" / "images.txt").unlink()
    (folder / "points3D.ply").unlink()
    document = json.loads((folder / "transforms_train.json").read_text())
    (folder / "transforms_train.json").write_text(
        json.dumps({**document, "frames": document["frames"][:2]})
    )
    assert write_capture(source(CUBE), cameras(), folder, **words).rendered == 2
    assert contents(folder) == wanted
    before = {path: path.stat().st_mtime_ns for path in (folder / "images").iterdir()}
    assert write_capture(source(CUBE), cameras(), folder, **words).rendered == 0
    assert {
        path: path.stat().st_mtime_ns for path in (folder / "images").iterdir()
    } == before


def test_what_cannot_be_captured(tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "notes.txt").write_text("mine")
    (tmp_path / "torn").mkdir()
    (tmp_path / "torn" / "capture.json").write_text("{")
    away = [
        Camera(
            to_world=look_at((0, 0, 5), (0, 0, 9)), lens=Lens(focal=9.0, size=(8, 8))
        )
    ]
    wide = Camera(
        to_world=cameras()[0].to_world, lens=Lens(focal=(9.0, 10.0), size=(8, 8))
    )
    refused: list[tuple[str, list[Camera], str]] = [
        ("a", [], "cameras"),
        ("a", [wide], "square pixels"),
        ("a", away, "nothing but sky"),
        ("mine", cameras(), r"notes\.txt in it"),
        ("torn", cameras(), r"capture\.json"),
    ]
    for folder, given, words in refused:
        with pytest.raises(InvalidValueError, match=words):
            write_capture(source(CUBE), given, tmp_path / folder, settings=QUICK)
    assert not (tmp_path / "a").exists()


def test_alpha_leaves_the_surfaces_alone(tmp_path: Path) -> None:
    settings = CaptureSettings(samples=16, rgba=True, points=300)
    write_capture(source(CUBE), cameras(2), tmp_path, settings=settings)
    black, white = (
        load_dataset(tmp_path, background=(level,) * 3) for level in (0.0, 1.0)
    )
    mask = black.alpha(0)
    assert mask is not None
    assert mask[0, 0] == 0
    assert mask[8, 8] == 1
    assert bool(((mask > 0) & (mask < 1)).any())  # edges
    assert white[0].image[0, 0].tolist() == [1, 1, 1]
    assert torch.equal(black[0].image[8, 8], white[0].image[8, 8])
    opaque = capture(source(CUBE).scene, cameras(2)[:1], samples=16)[0].image
    assert (black[0].image - opaque)[mask == 1].abs().max() < 1 / 255
    edge = (mask > 0.2) & (mask < 1)
    straight = (black[0].image[edge] / mask[edge][:, None])[:, 0]
    # not darkened by what is behind
    assert (straight - black[0].image[mask == 1][:, 0].mean()).abs().max() < 0.35


def test_points_lie_on_what_is_seen_in_its_colours() -> None:
    cameras = hemisphere(
        (0, 0, 0.5),
        count=8,
        distance=3.0,
        elevation=(10, 60),
        lens=Lens(focal=108.0, size=(96, 96)),
    )
    for assets in ((CUBE,), (CUBE, FLOOR)):
        scene = source(*assets).scene
        views = capture(scene, cameras, samples=4)
        cloud = surface_points(PathTracer(scene), assets, views, count=400, seed=0)
        points = cloud.points.numpy()
        on_cube = np.abs(np.abs(points - (0, 0, 0.5)).max(1) - 0.5) < 1e-4
        on_floor = np.abs(points[:, 2]) < 1e-4
        assert bool((on_cube | on_floor).all())
        assert 380 <= len(cloud) <= 400
        if len(assets) == 2:
            assert 190 <= (on_cube & ~on_floor).sum() <= 210
        upper = on_cube & (points[:, 2] > 0.05)
        assert float(cloud.colours[torch.from_numpy(upper)].mean(0)[0]) > 2 * float(
            cloud.colours[upper].mean(0)[1]
        )
        underneath = (np.abs(points[:, :2]) < 0.4).all(1) & (points[:, 2] < 1e-4)
        # nothing shows it, but images of this size leave some slack
        assert underneath.sum() <= 4
        unknown = surface_points(PathTracer(scene), (), views, count=400, seed=0)
        assert len(unknown) == 400
        surface = (
            np.abs(np.abs(unknown.points.numpy() - (0, 0, 0.5)).max(1) - 0.5) < 1e-3
        )
        assert bool((surface | (np.abs(unknown.points.numpy()[:, 2]) < 1e-3)).all())
