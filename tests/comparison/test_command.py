"""`mi-splat compare`, end to end on a shipped scene, and what it refuses before it
works.
"""

import json
from pathlib import Path

import pytest
import torch
from PIL import Image

from attacks import cli
from attacks.studies.compare import Comparing, files_of
from attacks.studies.running import run_study
from mi_splat.cli.options import CameraOptions
from mi_splat.comparison.methods import OverMeshes
from mi_splat.io import save_splat
from mi_splat.render.renderer import Renderer, RenderSettings
from mi_splat.render.scene_files import MixedScene, resized
from tests.fakes import toy_scene
from tests.project.layers import ROOT

pytestmark = pytest.mark.shipped

SCENE = str(ROOT / "scenes" / "car_street.xml")
STREET = ROOT / "scenes" / "mixed" / "car_among_meshes.xml"
SMALL = ["--cameras", "front", "--size", "40x32"]


@pytest.fixture
def toy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    save_splat(toy_scene()[0], tmp_path / "toy.ply")
    (tmp_path / "taken").mkdir()
    (tmp_path / "taken" / "wedding.jpg").write_text("dear")
    (tmp_path / "theirs").mkdir()
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.nightly
def test_a_shipped_scene(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert (
        cli.main(
            ["render", SCENE, *SMALL, "--cameras", "front", "side", "--out", "theirs"]
        )
        == 0
    )
    capsys.readouterr()
    words = [
        "compare",
        SCENE,
        *SMALL,
        "--methods",
        "tile,ray",
        "folder:theirs",
        "--rounds",
        "1",
        "--out",
        "compared",
    ]
    assert cli.main([*words, "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    kept = json.loads((tmp_path / "compared" / "result.json").read_text())
    assert document == {**kept, "out": "compared"}
    assert {"versions", "commit", "variant", "scene_hash", "near", "background"} <= set(
        kept
    )
    pairs = {tuple(pair["methods"]): pair for pair in kept["pairs"]}
    assert set(pairs) == {("tile", "ray"), ("tile", "theirs"), ("ray", "theirs")}
    assert pairs["tile", "theirs"]["psnr"] is None
    assert pairs["tile", "ray"]["psnr"] == pytest.approx(
        pairs["ray", "theirs"]["psnr"], abs=0.1
    )
    assert 0 < pairs["tile", "ray"]["gradients"]["sh"]["cosine"] < 1
    with Image.open(tmp_path / "compared" / "front.png") as sheet:
        assert sheet.size == (3 * 280 + 8, 2 * 224 + 4)
    with Image.open(
        tmp_path / "compared" / "pictures" / "ray" / "front.png"
    ) as picture:
        assert picture.size == (40, 32)

    text = (tmp_path / "compared" / "table.md").read_text()
    assert "| car_street.xml, front, " not in text
    assert "| car_street.xml | " in text
    assert "![front](front.png)" in text


@pytest.mark.parametrize(
    ("words", "status", "message"),
    [
        (["--methods", "tile"], 1, "expected two or more, got tile"),
        (
            ["--methods", "tile,folder:theirs"],
            1,
            "orbit.png for the camera orbit, got an empty folder",
        ),
        (["--rounds", "-1"], 2, "--rounds: expected"),
        (["--out", "taken"], 1, "a new or an empty folder"),
        (["--out", "taken", "--force"], 1, "an older result (result.json)"),
    ],
)
def test_refused_in_one_line_with_nothing_written(
    words: list[str],
    status: int,
    message: str,
    toy: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    before = sorted(toy.rglob("*"))
    assert cli.main(["compare", "toy.ply", "--size", "16", *words]) == status
    error = capsys.readouterr().err
    assert message in error
    assert len(error.splitlines()) == 1
    assert sorted(toy.rglob("*")) == before


def test_a_folder_that_is_called_like_a_method_is_no_input(toy: Path) -> None:
    for name in ("tile", "orbit:4@20", "all"):
        (toy / name).mkdir()
        (toy / name / "a.png").touch()
    view = CameraOptions(cameras=("all", "orbit:4@20"))
    files = files_of(Comparing(scene="toy.ply", methods=("tile", "ray"), view=view))
    # cameras are read of that one
    assert sorted(path.parent.name for path in files.values()) == ["", "orbit:4@20"]


@pytest.mark.slow
def test_a_study_of_a_splat_among_meshes(tmp_path: Path) -> None:
    (tmp_path / "light.toml").write_text(f"""
study = "compare"
scene = "{STREET}"
methods = ["path-traced-4", "tile"]
config = {{ rounds = 1, gradients = false }}
view = {{ size = [16, 16], cameras = ["side"] }}
[matrix]
sun = [
  {{ name = "noon", parameters = {{ sun_x = 0.0 }} }},
  {{ name = "morning", parameters = {{ sun_x = 2.0 }} }},
]
""")
    result = run_study(
        tmp_path / "light.toml", out=tmp_path / "result", store=tmp_path / "store"
    )
    noon, morning = json.loads((result / "result.json").read_text())["points"].values()
    assert morning["pairs"][0]["psnr"] != noon["pairs"][0]["psnr"]
    assert sorted(path.name for path in (result / "pictures").iterdir()) == [
        "morning.png",
        "noon.png",
    ]
    assert "| noon | " in (result / "table.md").read_text()


def test_a_composite_shows_the_splat_where_no_mesh_is_in_front() -> None:
    meshes = MixedScene(STREET, samples=1)
    scene = meshes.splats.scene
    camera = resized(meshes.splats.cameras["side"], (64, 64))
    tile = Renderer(RenderSettings(near=meshes.splats.settings.near))
    side = tile.outputs(scene, camera)
    image = OverMeshes(tile, meshes)(scene, camera)
    behind = meshes(scene.replace(opacities=torch.zeros_like(scene.opacities)), camera)
    hidden = meshes.depths(camera) < side.depth
    opaque = side.alpha > 0.999
    assert (hidden & opaque).sum() > 20  # by the lamp post and the shelter
    # threads add samples in any order
    torch.testing.assert_close(image[hidden], behind[hidden], rtol=0, atol=1e-6)
    shown = opaque & ~hidden
    assert shown.sum() > 200
    torch.testing.assert_close(image[shown], side.image[shown], rtol=0, atol=2e-3)
