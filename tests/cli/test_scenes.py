"""Commands on scenes: `render` on splats and XML, `dagger` on a toy scene with a fake
renderer and detector.
"""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from attacks import cli
from mi_splat.cameras.camera import Camera, look_at, project_points
from mi_splat.cameras.framing import bounds
from mi_splat.cameras.lens import Lens
from mi_splat.cli import cameras as cli_cameras
from mi_splat.errors import InvalidValueError
from mi_splat.io import load_splat, save_splat
from mi_splat.render import scene_files
from mi_splat.render.renderer import RenderSettings
from mi_splat.render.scene_files import SplatScene
from mi_splat.scene import GaussianScene
from tests.fakes import ColourDetector, blobs, camera, toy_scene

XML = """
<scene version="3.0.0">
    <integrator type="splat_tile"/>
    <shape type="gaussians" id="cloud"><string name="filename" value="cloud.ply"/>
      </shape>
    <sensor type="perspective" id="front">
        <float name="fov" value="40"/>
        <transform name="to_world">
          <lookat origin="9, 2, 3" target="1, 2, 3" up="0, 0, 1"/></transform>
        <film type="hdrfilm"><integer name="width" value="48"/>
          <integer name="height" value="32"/></film>
    </sensor>
    <sensor type="perspective" id="side">
        <float name="fov" value="40"/>
        <transform name="to_world">
          <lookat origin="1, 10, 3" target="1, 2, 3" up="0, 0, 1"/></transform>
        <film type="hdrfilm"><integer name="width" value="20"/>
          <integer name="height" value="40"/></film>
    </sensor>
</scene>
"""


@pytest.fixture
def cloud() -> GaussianScene:
    """A ball of 400 bright Gaussians around (1, 2, 3)."""
    count = 400
    return GaussianScene(
        means=torch.tensor([1.0, 2.0, 3.0]) + 0.3 * torch.randn(count, 3),
        scales=torch.full((count, 3), 0.1),
        rotations=torch.nn.functional.normalize(torch.randn(count, 4), dim=1),
        opacities=torch.full((count,), 0.8),
        sh=torch.ones(count, 1, 3),
    )


@pytest.fixture
def folder(tmp_path: Path, cloud: GaussianScene) -> Path:
    """A folder with the cloud as a splat file and a scene XML."""
    save_splat(cloud, tmp_path / "cloud.ply")
    (tmp_path / "scene.xml").write_text(XML)
    return tmp_path


def pixels(path: Path) -> np.ndarray:
    """(H, W, 3) levels of a PNG."""
    with Image.open(path) as picture:
        return np.asarray(picture)


def test_render_takes_the_first_camera_or_the_one_named(folder: Path) -> None:
    for words, shape in (
        ([], (32, 48, 3)),
        (["--cameras", "side"], (40, 20, 3)),
        (["--size", "24x16"], (16, 24, 3)),
    ):
        out = folder / "picture.png"
        assert (
            cli.main(
                [
                    "render",
                    str(folder / "scene.xml"),
                    "--out",
                    str(out),
                    "--force",
                    *words,
                ]
            )
            == 0
        )
        picture = pixels(out)
        assert picture.shape == shape
        assert picture[shape[0] // 2, shape[1] // 2].min() > 128


def test_a_scene_names_splats_of_any_format(folder: Path, cloud: GaussianScene) -> None:
    """glTF holds all of a scene, so the image is the same to the bit; a bare file is
    drawn as the PLY is.
    """
    save_splat(cloud, folder / "cloud.glb")
    (folder / "other.xml").write_text(XML.replace("cloud.ply", "cloud.glb"))
    pictures = {}
    for name in ("scene.xml", "other.xml", "cloud.ply", "cloud.glb"):
        assert (
            cli.main(
                [
                    "render",
                    str(folder / name),
                    "--out",
                    str(folder / "a.png"),
                    "--size",
                    "32x24",
                    "--force",
                ]
            )
            == 0
        )
        pictures[name] = pixels(folder / "a.png")
    assert np.array_equal(pictures["scene.xml"], pictures["other.xml"])
    assert np.array_equal(pictures["cloud.ply"], pictures["cloud.glb"])


def test_info_lists_parts_and_cameras(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["info", str(folder / "scene.xml"), "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["parts"] == {"cloud": 400}
    assert facts["part_bounds"]["cloud"] == facts["bounds"]
    assert facts["cameras"] == {"front": "48 x 32", "side": "20 x 40"}


def test_an_empty_scene_has_no_camera(cloud: GaussianScene) -> None:
    with pytest.raises(InvalidValueError, match="scene"):
        bounds(cloud.select(slice(0, 0)))


def test_a_resized_camera_sees_the_same() -> None:
    pose = look_at((3.0, 0.0, 1.0), (0.0, 0.0, 0.0))
    small = Camera(
        to_world=pose,
        lens=Lens(focal=(50.0, 60.0), size=(40, 30), principal=(18.0, 16.0)),
    )
    large = scene_files.resized(small, (80, 60))
    points = torch.randn(20, 3, dtype=torch.float64)
    assert torch.allclose(
        2 * project_points(points, small)[0], project_points(points, large)[0]
    )


@pytest.fixture
def toy(monkeypatch: pytest.MonkeyPatch) -> SplatScene:
    """The toy scene in the place of files, renderer and weights."""
    scene, _ = toy_scene()
    objects = {"rest": slice(0, 10), "thing": slice(10, 40)}
    cameras = {"front": camera(), "aside": camera(offset=0.3)}
    loaded = SplatScene(
        scene=scene, objects=objects, cameras=cameras, settings=RenderSettings()
    )
    monkeypatch.setattr("mi_splat.render.scene_files.open_scene", lambda *_: loaded)
    monkeypatch.setattr(cli_cameras, "Renderer", lambda settings: blobs)
    monkeypatch.setattr(
        "attacks.cli.options.load_detectors", lambda *_: [ColourDetector()]
    )
    return loaded


def test_dagger_writes_its_report(
    toy: SplatScene, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    words = [
        "--object",
        "thing",
        "--target",
        "person",
        "--eps",
        "20",
        "--seed",
        "3",
        "--noise-draws",
        "1",
    ]
    assert cli.main(["dagger", "toy.xml", *words, "--out", str(out)]) == 0
    lines = capsys.readouterr().out.splitlines()
    printed = (
        "The attack succeeded: within a ball (l2: 20 over sh) it made fake_colour"
        " report person on the object in 1 of 1"
    )
    assert lines[0].startswith(printed)
    assert lines[1].startswith("attack success rate (ASR): report person  ")
    assert "1 of 1 = 100 % (20.7 to 100 %); confidence " in lines[1]
    assert lines[-2] == f"Open {out / 'detections.png'} first."
    names = {
        "before.png",
        "after.png",
        "difference.png",
        "detections.png",
        "attacked.ply",
        "result.json",
        "mask.npy",
    }
    names |= {"cameras.json", "figures.csv", "rows.csv.xz", "detections.csv.xz"}
    names |= {
        "manifest.json",
        "attacked.xml",
        "attacked_rest.ply",
        "attacked_thing.ply",
    }
    assert {path.name for path in out.iterdir()} == names
    result = json.loads((out / "result.json").read_text())
    assert set(result) >= {"success", "config", "versions", "variant", "scene_hash"}
    assert (result["target"], result["eps"], result["seed"]) == ("person", 20.0, 3)
    assert (result["selection"], result["cameras"]) == ({"object": "thing"}, ["front"])
    attacked = load_splat(out / "attacked.ply")
    # the scene has degree 1, the attack makes it 3
    lower = attacked.sh[:, :4]
    higher = attacked.sh[:, 4:]
    assert torch.equal(lower[:10], toy.scene.sh[:10])
    assert not higher[:10].any()
    assert not torch.equal(lower[10:], toy.scene.sh[10:])
    assert higher[10:].any()


def test_dagger_prints_one_document(
    toy: SplatScene, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = [
        "--object",
        "thing",
        "--objective",
        "hide",
        "--attributes",
        "opacities",
        "sh",
        "--eps",
        "3",
        "20",
    ]
    words += [
        "--cameras",
        "front",
        "aside",
        "--norm",
        "l2_per_gaussian",
        "--noise-draws",
        "0",
        "--json",
    ]
    assert cli.main(["dagger", "toy.xml", *words, "--out", str(tmp_path)]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["target"] is None
    assert document["radius"] == {"opacities": 3.0, "sh": 20.0}
    assert len(document["views"]) == 2
    assert document["out"] == str(tmp_path)


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["--object", "bicycle"], "rest, thing"),
        (
            ["--object", "thing", "--target", "car"],
            "expected another class than is seen before the attack, got car",
        ),
        (["--object", "thing", "--cameras", "behind"], "front, aside"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_dagger_says_what_is_wrong(
    words: list[str],
    says: str,
    toy: SplatScene,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert cli.main(["dagger", "toy.xml", *words, "--out", str(tmp_path / "out")]) == 1
    captured = capsys.readouterr()
    assert says in captured.err
    assert len(captured.err.splitlines()) == 1
    assert not (tmp_path / "out").exists()
