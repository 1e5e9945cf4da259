"""Results of attacks in the viewer: both splats, the cameras and numbers of the result,
words where one is broken.
"""

import json
import shlex
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from PIL import Image, ImageDraw

from attacks import cli
from attacks.cloak.config import AttackConfig, CameraConfig, StudyConfig
from attacks.cloak.setup import Setup
from attacks.detectors import load_detector
from attacks.report.viewer_content import (
    DetectorInspection,
    detector_inspector,
    middle_of_change,
    open_content,
)
from mi_splat.audit.files import write as write_files
from mi_splat.errors import InvalidValueError, MiSplatError
from mi_splat.io import save_splat
from mi_splat.render.renderer import Renderer
from mi_splat.viewer.painter import Painter
from tests.audit.accounts import account, cone
from tests.fakes import ColourDetector, register
from tests.project.layers import ROOT
from tests.viewer.contents import ball, save_study

pytestmark = pytest.mark.shipped

STREET = ROOT / "scenes" / "car_street.xml"
STUDY = StudyConfig(
    name="small",
    cameras=CameraConfig(train=30, size=64, distance=7.0),
    attack=(
        AttackConfig(name="overhead", elevation=(50.0, 90.0)),
        AttackConfig(
            name="rear",
            elevation=(0.0, 40.0),
            azimuth=(180.0, 30.0),
            poison_fraction=0.5,
        ),
    ),
)


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory, variant: str) -> Path:
    """What one step of DAGGER leaves behind."""
    out = tmp_path_factory.mktemp("result") / "dagger"
    words = [
        "dagger",
        str(STREET),
        "--steps",
        "1",
        "--noise-draws",
        "1",
        "--eps",
        "5",
        "--out",
        str(out),
    ]
    assert cli.main(words) == 0
    return out


@pytest.fixture
def study(tmp_path: Path) -> Path:
    """What a study of CLOAK leaves behind, as far as it is read."""
    save_study(tmp_path, STUDY)
    return tmp_path


def test_the_numbers_are_those_of_the_result(result: Path) -> None:
    content = open_content(result, clean=STREET)
    work = Painter(
        content,
        Renderer(content.settings),
        detector_inspector(load_detector("fasterrcnn_small")),
    )
    listed = json.loads((result / "result.json").read_text())
    assert content.size == tuple(listed["views"][0]["camera"]["size"])
    for name in ("clean", "attacked"):
        inspection = work.inspect(name, content.cameras["attacked view 0"])
        assert isinstance(inspection, DetectorInspection)
        expected = listed["views"][0][name]
        assert list(inspection.detections.labels) == [
            line["label"] for line in expected
        ]
        assert inspection.detections.scores.tolist() == pytest.approx(
            [line["score"] for line in expected], abs=1e-5
        )
        assert inspection.text.startswith(
            f"{expected[0]['label']} {inspection.detections.scores[0]:.1%}"
        )
    assert work.similarity(content.start) == pytest.approx(
        listed["image_psnr"], abs=1e-3
    )
    assert content.title.startswith(
        "DAGGER on car_street: target class person, fasterrcnn_small ("
    )


def test_a_result_s_cameras_come_first_and_go_around_the_attacked_object(
    result: Path,
) -> None:
    content = open_content(result, clean=STREET)
    assert content.names == ("clean", "attacked")
    assert list(content.cameras)[:2] == ["attacked view 0", "front"]
    assert content.start == content.cameras["attacked view 0"]
    # the car stands at the origin
    assert max(abs(value) for value in content.start.target) < 1.5


def test_an_evaluation_shows_both_splats_from_its_cameras(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, variant: str
) -> None:
    register(monkeypatch, {"fake_colour": ColourDetector()})
    save_splat(ball((0.8, 0.1, 0.1)), tmp_path / "a.ply")
    attacked = tmp_path / "b.ply"
    save_splat(ball((0.1, 0.1, 0.8)), attacked)
    words = [
        "evaluate",
        str(tmp_path / "a.ply"),
        str(attacked),
        "--detectors",
        "fake_colour",
        "--out",
    ]
    assert (
        cli.main(
            [
                *words,
                str(tmp_path / "judged"),
                "--cameras",
                "orbit:2@10",
                "--size",
                "40x32",
            ]
        )
        == 0
    )
    content = open_content(tmp_path / "judged")
    assert content.names == ("clean", "attacked")
    assert list(content.cameras) == ["orbit-0", "orbit-1", "whole scene"]
    assert (content.size, content.title[:20]) == ((40, 32), "Evaluation of b.ply ")
    command = shlex.split(
        Painter(content, Renderer(content.settings)).commands(content.start)["attacked"]
    )
    assert command[3:5] == [
        "--cameras",
        f"{tmp_path / 'judged' / 'result.json'}#orbit-0",
    ]
    assert cli.main([*command[1:], "--out", str(tmp_path / "again.png")]) == 0
    save_splat(ball((0.1, 0.8, 0.8)), attacked)
    with pytest.raises(
        InvalidValueError, match="expected the splat that was evaluated, got another"
    ):
        open_content(tmp_path / "judged")


def test_the_clean_scene_is_found_by_its_hash(
    result: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    assert open_content(result).splat("clean").path == STREET  # as the result names it
    moved = tmp_path / "moved"
    shutil.copytree(result, moved)
    document = json.loads((moved / "result.json").read_text())
    (moved / "result.json").write_text(json.dumps({**document, "scene": "gone.xml"}))
    with pytest.raises(
        InvalidValueError, match="no such scene here; name the clean scene"
    ):
        open_content(moved)
    monkeypatch.chdir(ROOT)
    assert open_content(moved).splat("clean").path == Path("scenes/car_street.xml")
    with pytest.raises(
        InvalidValueError, match=r"expected the hash .*pass the scene that was attacked"
    ):
        open_content(result, clean=ROOT / "scenes" / "stop_sign.xml")


def test_an_older_result_is_shown_as_its_scene_is(result: Path, tmp_path: Path) -> None:
    values = json.loads((result / "result.json").read_text())
    shutil.copytree(result, tmp_path / "older")
    older = {
        key: value for key, value in values.items() if key not in ("near", "background")
    }
    (tmp_path / "older" / "result.json").write_text(json.dumps(older))
    first, second = (
        open_content(folder, clean=STREET) for folder in (result, tmp_path / "older")
    )
    assert len(values) == len(older) + 2
    assert first.settings == second.settings
    assert list(first.cameras) == list(second.cameras)


def test_up_turns_results_and_their_cameras_keep_their_pictures(
    result: Path, study: Path
) -> None:
    """Whatever is up; a result that says what it was made with needs no --up."""
    record = json.loads((result / "result.json").read_text())
    tilted = study / "tilted"
    shutil.copytree(result, tilted)
    (tilted / "result.json").write_text(json.dumps({**record, "up": [0.0, -1.0, 0.0]}))
    level = open_content(result, clean=STREET)
    content = open_content(tilted, clean=STREET)
    assert content.up == (0, -1, 0)
    assert abs(content.start.roll - level.start.roll) > 10
    assert (
        open_content(tilted, clean=STREET, up=(0.0, 0.0, 1.0)).start.roll
        == level.start.roll
    )
    pictures = [
        Painter(shown, Renderer(shown.settings)).picture("attacked", shown.start)
        for shown in (level, content)
    ]
    assert float((pictures[0] - pictures[1]).abs().max()) <= 2 / 255
    turned, flat = (open_content(study, up=up) for up in ((0.0, -1.0, 0.0), None))
    for name, orbit in flat.cameras.items():
        there = turned.describe(turned.cameras[name].camera((8, 8)))
        assert there == flat.describe(orbit.camera((8, 8)))


BROKEN = (
    "{",
    "[]",
    "{}",
    '{"views": [{}], "scene_hash": "x"}',
    '{"views": 3}',
    '{"story": "evaluate", "cameras": []}',
)


def test_what_is_no_result_is_told(tmp_path: Path) -> None:
    with pytest.raises(
        InvalidValueError,
        match=r"expected result\.json of mi-splat dagger, evaluate, cloak or audit",
    ):
        open_content(tmp_path)
    with pytest.raises(MiSplatError, match="expected"):
        open_content(tmp_path / "none.ply")
    for record in BROKEN:
        (tmp_path / "result.json").write_text(record)
        with pytest.raises(InvalidValueError, match=r"result\.json: expected"):
            open_content(tmp_path, clean=STREET)


def test_the_middle_of_what_changed() -> None:
    clean = ball((0.5, 0.5, 0.5))
    sh = clean.sh.clone()
    sh[3:5] += 0.5
    expected = clean.means[3:5].mean(0).tolist()
    assert middle_of_change(clean, replace(clean, sh=sh)) == pytest.approx(expected)
    middle_of_change(clean, clean)  # nothing has: the middle of all
    with pytest.raises(
        InvalidValueError, match="expected the same Gaussians in both, got 20 and 21"
    ):
        middle_of_change(clean, ball((0.5, 0.5, 0.5), 21))


def test_an_audit_shows_its_heat_from_the_cameras_that_prove_it(tmp_path: Path) -> None:
    scene = ball((0.5, 0.5, 0.5))
    file = tmp_path / "it.ply"
    folder = tmp_path / "audit"
    save_splat(scene, file)
    write_files(
        account(cone("contradicted"), count=len(scene)), scene, folder, source=str(file)
    )
    content = open_content(folder)
    assert content.names == ("audited", "heat")
    assert next(iter(content.cameras)) == "cone 1"
    assert content.start == content.cameras["cone 1"]
    assert content.start.elevation > 60
    moved = file.rename(tmp_path / "moved.ply")
    with pytest.raises(
        InvalidValueError, match=r"expected the file .* name the splat that was audited"
    ):
        open_content(folder)
    assert open_content(folder, clean=moved).splat("audited").path == moved
    save_splat(ball((0.5, 0.5, 0.5), 21), file)
    with pytest.raises(InvalidValueError, match="expected 20 Gaussians, got 21"):
        open_content(folder)
    (folder / "heat.ply").unlink()
    assert open_content(folder, clean=moved).names == ("audited",)


def test_a_study_shows_both_splats_from_its_cameras(study: Path) -> None:
    content = open_content(study)
    assert content.names == ("clean", "cloaked")
    assert content.settings.background == STUDY.scene.background
    assert content.size == (64, 64)
    assert list(content.cameras)[:3] == ["inside overhead", "inside rear", "start"]
    assert content.start == content.cameras["inside overhead"]
    centre = STUDY.centre
    for attack in STUDY.attack:
        camera = content.cameras[f"inside {attack.name}"].camera((8, 8))
        assert attack.cone.angle_to_edge(camera, centre=centre) > 10
    trained = Setup.of(STUDY).training_cameras
    listed = [
        orbit.exact for name, orbit in content.cameras.items() if "camera" in name
    ]
    assert len(listed) == len(trained)
    assert list(content.cameras)[3].startswith("poisoned camera")
    assert content.start.distance == pytest.approx(7.0)
    assert content.start.camera((64, 64)).fx == pytest.approx(trained[0].fx)
    overhead, rear = content.describe(
        content.start.changed(elevation=62.5).camera((8, 8))
    )
    assert overhead == "Trigger overhead: 12.5° inside"
    assert "outside" in rear


def test_a_broken_study_is_told(study: Path) -> None:
    with pytest.raises(InvalidValueError, match="clean: expected nothing"):
        open_content(study, clean=STREET)
    record = json.loads((study / "result.json").read_text())
    unnamed = {key: value for key, value in record["study"].items() if key != "name"}
    broken = {
        "a study of CLOAK": None,
        "the key name": unnamed,
        "colour": {**record["study"], "colour": 3},
    }
    for words, values in broken.items():
        (study / "result.json").write_text(
            json.dumps({"story": "cloak", "study": values})
        )
        with pytest.raises(MiSplatError, match=words):
            open_content(study)
    (study / "result.json").write_text(json.dumps(record))
    (study / "cloaked.ply").unlink()
    with pytest.raises(MiSplatError, match=r"cloaked\.ply"):
        open_content(study)


def test_detections_in_words_and_boxes() -> None:
    picture = torch.zeros(40, 40, 3)
    detector = ColourDetector()
    assert detector_inspector(detector)(picture).text == "nothing at 30% or more"
    picture[8:28, 8:28, 0] = 1.0
    inspection = detector_inspector(detector)(picture)
    (expected,) = detector.detect(picture[None])
    assert inspection.text.startswith(f"car {float(expected.scores[0]):.1%}")
    image = Image.new("RGB", (80, 80))
    inspection.draw(ImageDraw.Draw(image), 2.0)
    left, _, right, bottom = (2 * float(value) for value in expected.boxes[0])
    assert image.getpixel((round((left + right) / 2), round(bottom))) != (0, 0, 0)
    assert image.getpixel((78, 78)) == (0, 0, 0)


@pytest.mark.parametrize(
    "path", ["//host/share/a.ply", "\\\\host\\share\\a.ply", 7, None]
)
def test_no_path_of_a_record_leads_into_the_network(
    path: object, tmp_path: Path
) -> None:
    for story, key in (("audit", "file"), ("evaluate", "attacked")):
        record = {
            "story": story,
            key: path,
            "cameras": [],
            "objects": [{"evidence": 1, "centre": [0, 0, 0]}],
        }
        (tmp_path / "result.json").write_text(json.dumps({**record, "gaussians": 1}))
        with pytest.raises(
            MiSplatError, match="expected the path of a splat on this machine"
        ):
            open_content(tmp_path)
