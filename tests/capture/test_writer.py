"""Captures that are written as they go: the same bytes after any interruption, point clouds, refusals, the command."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from attacks import cli
from mi_splat.assets.mesh import Asset
from mi_splat.assets.primitives import box, quad
from mi_splat.camera_sets import hemisphere, orbit
from mi_splat.cameras import Camera
from mi_splat.capture.path_tracer import Light, PathTracer, capture, scene_dict
from mi_splat.capture.point_clouds import surface_points
from mi_splat.capture.sources import CaptureSource, open_source
from mi_splat.capture.writer import CaptureSettings, write_capture
from mi_splat.datasets import load_dataset
from mi_splat.errors import InvalidValueError, MiSplatError

RED, GREEN = (0.8, 0.1, 0.1), (0.1, 0.7, 0.1)
CUBE = Asset("cube", (box((1, 1, 1), RED, centre=(0, 0, 0.5)),))
FLOOR = Asset("floor", (quad([[-4, -4, 0], [4, -4, 0], [4, 4, 0], [-4, 4, 0]], GREEN),))
EVEN = Light(sun_strength=0.0, sky_strength=1.0, zenith=(1, 1, 1), horizon=(1, 1, 1), clouds=0.0)
STILL_LIFE = Path(__file__).parents[2] / "scenes" / "meshes" / "still_life.xml"
QUICK = CaptureSettings(samples=2, points=300)

XML = """<scene version="3.0.0"><integrator type="path"/><emitter type="constant"/>
<shape type="cube"><bsdf type="diffuse"><rgb name="reflectance" value="0.8, 0.1, 0.1"/></bsdf></shape></scene>"""
OBJ = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"


def source(*assets: Asset) -> CaptureSource:
    first, *others = assets
    scene = scene_dict([first], light=EVEN, backdrop=others[0] if others else None)
    return CaptureSource(scene=scene, centre=(0, 0, 0.5), radius=0.9, assets=assets, digest=f"{len(assets)}")


def cameras(count: int = 4, **change: Any) -> list[Camera]:
    values = {"distance": 3.0, "focal": 18.0, "size": (16, 16), "elevation": 30.0, **change}
    return orbit((0, 0, 0.5), count=count, **values)


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize("layout", ["transforms", "colmap", "both"])
def test_a_capture_is_a_set(layout: Any, tmp_path: Path) -> None:
    seen: list[tuple[int, int]] = []
    test = cameras(2, start=45.0)
    done = write_capture(
        source(CUBE), cameras(), tmp_path / "set", test=test, settings=QUICK, layout=layout,
        on_step=lambda number, total: seen.append((number, total)),
    )  # fmt: skip
    assert (done.train, done.test, done.rendered) == (4, 2, 6)
    assert seen == [(i, 6) for i in range(1, 7)]
    assert all(file.is_file() for file in done.files)
    taken = capture(source(CUBE).scene, [*cameras(), *test], samples=2)
    for split, part in (("train", taken[:4]), ("test", taken[4:])):
        found = load_dataset(tmp_path / "set", split=split)  # type: ignore[arg-type]
        for ours, theirs in zip(found, part, strict=True):
            assert (ours.image - theirs.image).abs().max() <= 0.5 / 255 + 1e-6
            torch.testing.assert_close(ours.camera.to_world, theirs.camera.to_world, atol=1e-6, rtol=0)
        assert found.points is not None
        assert len(found.points) == done.points


def test_a_capture_goes_on_where_it_stopped(tmp_path: Path) -> None:
    words: dict[str, Any] = {"test": cameras(1, start=45.0), "settings": QUICK, "layout": "both"}
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
    (folder / "images" / "test_00000.png").write_bytes(wanted["images/test_00000.png"][:60])
    (folder / "sparse" / "0" / "images.txt").unlink()
    (folder / "points3D.ply").unlink()
    document = json.loads((folder / "transforms_train.json").read_text())
    (folder / "transforms_train.json").write_text(json.dumps({**document, "frames": document["frames"][:2]}))
    assert write_capture(source(CUBE), cameras(), folder, **words).rendered == 2
    assert contents(folder) == wanted
    before = {path: path.stat().st_mtime_ns for path in (folder / "images").iterdir()}
    assert write_capture(source(CUBE), cameras(), folder, **words).rendered == 0
    assert {path: path.stat().st_mtime_ns for path in (folder / "images").iterdir()} == before


def test_pictures_depend_on_seed_and_place_alone(tmp_path: Path) -> None:
    tracer = PathTracer(source(CUBE).scene, samples=2)
    first, second = cameras(2)
    alone = tracer.picture(second, seed=1)
    tracer.picture(first, seed=0)
    assert torch.equal(tracer.picture(second, seed=1), alone)
    assert not torch.equal(tracer.picture(second, seed=2), alone)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"settings": CaptureSettings(samples=3, points=300)}, "samples 2, now 3"),
        ({"settings": CaptureSettings(samples=2, points=300, seed=1)}, "seed 0, now 1"),
        ({"settings": CaptureSettings(samples=2, points=300, alpha=True)}, "alpha False, now True"),
        ({"cameras": cameras(3)}, "train 4, now 3"),
        ({"cameras": cameras(4, distance=3.1)}, "cameras '"),
        ({"test": cameras(1)}, "test 0, now 1"),
        ({"source": source(CUBE, FLOOR)}, "scene '1', now '2'"),
    ],
)
def test_a_folder_with_other_settings_is_refused(change: dict[str, Any], says: str, tmp_path: Path) -> None:
    words: dict[str, Any] = {"source": source(CUBE), "cameras": cameras(), "settings": QUICK}
    write_capture(**words, folder=tmp_path)
    before = contents(tmp_path)
    with pytest.raises(InvalidValueError, match=rf"capture\.json.*{says}.*new folder"):
        write_capture(**{**words, **change}, folder=tmp_path)
    assert contents(tmp_path) == before


def test_what_cannot_be_captured(tmp_path: Path) -> None:
    with pytest.raises(InvalidValueError, match="cameras"):
        write_capture(source(CUBE), [], tmp_path / "a")
    wide = Camera(to_world=cameras()[0].to_world, focal=(9.0, 10.0), width=8, height=8)
    with pytest.raises(InvalidValueError, match="fx equal to fy"):
        write_capture(source(CUBE), [wide], tmp_path / "a")
    assert not (tmp_path / "a").exists()
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(InvalidValueError, match=r"notes\.txt in it"):
        write_capture(source(CUBE), cameras(), tmp_path)
    (tmp_path / "capture.json").write_text("{")
    with pytest.raises(InvalidValueError, match=r"capture\.json"):
        write_capture(source(CUBE), cameras(), tmp_path)
    away = [Camera(to_world=torch.eye(4), focal=9.0, width=8, height=8)]
    with pytest.raises(InvalidValueError, match="nothing but sky"):
        write_capture(
            source(Asset("far", (box((1, 1, 1), RED, centre=(0, 0, -9)),))), away, tmp_path / "b", settings=QUICK
        )
    assert not (tmp_path / "b").exists()
    for name in ("samples", "seed", "points"):
        with pytest.raises(InvalidValueError, match=name):
            CaptureSettings(**{name: -1})  # type: ignore[arg-type]


def test_alpha_leaves_the_surfaces_alone(tmp_path: Path) -> None:
    settings = CaptureSettings(samples=16, alpha=True, points=300)
    write_capture(source(CUBE), cameras(2), tmp_path, settings=settings)
    black, white = (load_dataset(tmp_path, background=(level,) * 3) for level in (0.0, 1.0))
    mask = black.mask(0)
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
    assert (straight - black[0].image[mask == 1][:, 0].mean()).abs().max() < 0.35  # not darkened by what is behind


def test_points_lie_on_what_is_seen_in_its_colours() -> None:
    spots = hemisphere((0, 0, 0.5), count=8, distance=3.0, focal=108.0, size=(96, 96), elevation=(10, 60))
    for assets in ((CUBE,), (CUBE, FLOOR)):
        scene = source(*assets).scene
        views = capture(scene, spots, samples=4)
        cloud = surface_points(PathTracer(scene), assets, views, count=400, seed=0)
        points = cloud.points.numpy()
        on_cube = np.abs(np.abs(points - (0, 0, 0.5)).max(1) - 0.5) < 1e-4
        on_floor = np.abs(points[:, 2]) < 1e-4
        assert bool((on_cube | on_floor).all())
        assert 380 <= len(cloud) <= 400
        if len(assets) == 2:
            assert 190 <= (on_cube & ~on_floor).sum() <= 210
        upper = on_cube & (points[:, 2] > 0.05)
        assert float(cloud.colours[torch.from_numpy(upper)].mean(0)[0]) > 2 * float(cloud.colours[upper].mean(0)[1])
        underneath = (np.abs(points[:, :2]) < 0.4).all(1) & (points[:, 2] < 1e-4)
        assert underneath.sum() <= 4  # nothing shows it, but pictures of this size leave some slack
        unknown = surface_points(PathTracer(scene), (), views, count=400, seed=0)
        assert len(unknown) == 400
        surface = np.abs(np.abs(unknown.points.numpy() - (0, 0, 0.5)).max(1) - 0.5) < 1e-3
        assert bool((surface | (np.abs(unknown.points.numpy()[:, 2]) < 1e-3)).all())


def test_subjects(tmp_path: Path) -> None:
    car = open_source("car_street")
    assert len(car.assets) == 2
    assert 2 < car.radius < 4
    still = open_source(str(STILL_LIFE))
    assert still.assets == ()
    assert still.centre == pytest.approx((0, 0, 0.6), abs=1e-3)
    (tmp_path / "cube.xml").write_text(XML)
    cube = open_source(str(tmp_path / "cube.xml"))
    assert cube.radius == pytest.approx(3**0.5, abs=1e-3)
    (tmp_path / "cube.xml").write_text(XML.replace("0.8", "0.7"))
    assert open_source(str(tmp_path / "cube.xml")).digest != cube.digest
    pytest.importorskip("trimesh")
    (tmp_path / "mesh.obj").write_text(OBJ)
    mesh = open_source(str(tmp_path / "mesh.obj"), scale=2.0, up="z")
    assert mesh.assets[0].bounds.tolist() == [[0, 0, 0], [2, 2, 2]]
    assert mesh.digest == open_source(str(tmp_path / "mesh.obj"), scale=2.0, up="z").digest
    assert mesh.digest != open_source(str(tmp_path / "mesh.obj"), scale=2.0).digest
    with pytest.raises(InvalidValueError, match="radius"):
        open_source(str(tmp_path / "mesh.obj"), scale=1e4)


def words(folder: Path, *more: str) -> list[str]:
    return [
        "capture",
        str(STILL_LIFE),
        "--out",
        str(folder),
        "--size",
        "16",
        "--samples",
        "2",
        "--points",
        "200",
        *more,
    ]


def test_the_command_writes_a_set_and_says_so(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "new" / "set"
    command = words(out, "--cameras", "cap:3@40", "--test", "2", "--format", "both", "--distance", "5")
    assert cli.main(command) == 0
    lines = capsys.readouterr().out.splitlines()
    assert "5 pictures of 16 x 16 (2 of them held out); 5 rendered" in lines[0]
    assert "200 points; listed in points3D.ply, transforms_train.json, transforms_test.json, sparse/0/" in lines[1]
    assert len(load_dataset(out)) == 3
    before = contents(out)
    assert cli.main([*command, "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert (document["train"], document["test"], document["rendered"]) == (3, 2, 0)
    assert contents(out) == before
    assert cli.main(words(out, "--cameras", "cap:3@40")) == 1
    assert "test 2, now 0" in capsys.readouterr().err


def test_the_command_takes_cameras_of_a_file_and_sizes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(words(tmp_path / "a", "--cameras", "orbit:2@30", "--size", "20", "12", "--rgba")) == 0
    again = words(tmp_path / "b", "--cameras", str(tmp_path / "a" / "transforms_train.json"))
    assert cli.main(again) == 0
    ours, theirs = (load_dataset(tmp_path / name) for name in "ab")
    assert ours.mask(0) is not None
    assert theirs[0].image.shape == (12, 20, 3)
    assert all(torch.equal(a.to_world, b.to_world) for a, b in zip(ours.cameras, theirs.cameras, strict=True))


@pytest.mark.parametrize(
    ("more", "says"),
    [
        (["--cameras", "sphere:3"], "hemisphere:N"),
        (["--cameras", "none.json"], "none.json"),
        (["--samples", "0"], "samples"),
        (["--size", "0"], "size"),
        (["--size", "1", "2", "3"], "size"),
        (["--size", "99999"], "width"),
        (["--fov", "180"], "fov"),
        (["--distance", "-1"], "distance"),
        (["--test", "-1"], "test"),
        (["--seed", "-1"], "seed"),
        (["--points", "0"], "points"),
        (["--up", "y"], "--up"),
        (["--scale", "2"], "--scale"),
    ],
    ids=" ".join,
)
def test_the_command_refuses_before_it_begins(
    more: list[str], says: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    assert cli.main(words(out, *more)) == 1
    captured = capsys.readouterr()
    assert says in captured.err
    assert len(captured.err.splitlines()) == 1
    assert not out.exists()


@pytest.mark.parametrize(
    ("name", "content", "says"),
    [
        ("lorry", None, "car_street, stop_sign"),
        ("none.xml", None, "none.xml"),
        ("none.obj", None, "none.obj"),
        ("bad.xml", "<scene", "bad.xml"),
        ("empty.xml", '<scene version="3.0.0"/>', "empty.xml"),
        ("unknown.xml", '<scene version="3.0.0"><shape type="teapot"/></scene>', "unknown.xml"),
    ],
)
def test_the_command_refuses_scenes(
    name: str, content: str | None, says: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    if name.endswith(".obj"):
        pytest.importorskip("trimesh")
    scene = tmp_path / name
    if content is not None:
        scene.write_text(content)
    assert cli.main(["capture", str(scene) if "." in name else name, "--out", str(tmp_path / "out")]) == 1
    captured = capsys.readouterr()
    assert says in captured.err
    assert len(captured.err.splitlines()) == 1
    assert not (tmp_path / "out").exists()


def test_scenes_that_mitsuba_cannot_load_are_named(tmp_path: Path) -> None:
    (tmp_path / "bad.xml").write_text("<scene")
    with pytest.raises(MiSplatError, match=r"bad\.xml: expected a scene"):
        open_source(str(tmp_path / "bad.xml"))


def test_an_asset_by_name_and_seed_is_a_subject() -> None:
    one, other, same = (open_source(name) for name in ("car:3", "car:4", "car:3"))
    assert one.digest == same.digest != other.digest
    assert len(one.assets) == 1
    with pytest.raises(InvalidValueError, match="change the seed"):
        open_source("car:three")
