"""What a page does with a splat is what its command does: the words are read back, and results are opened."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from attacks import cli
from attacks.cli import laboratory
from attacks.cli.laboratory import ATTACK, AUDIT, JUDGE, MISSED, Laboratory, Watched, perform, without
from attacks.detectors.registry import DETECTORS
from attacks.observe.look import Looked
from attacks.observe.rows import frame_of
from mi_splat.audit.files import write as write_files
from mi_splat.cli.cameras import find_cameras
from mi_splat.errors import InvalidValueError
from mi_splat.io import save_splat
from mi_splat.io.folders import RECORD
from mi_splat.scene_files import open_scene
from mi_splat.viewer.composition import Pixels
from mi_splat.viewer.exhibit import Exhibit, exhibit_of_file
from mi_splat.viewer.jobs import News, Request, Value
from mi_splat.viewer.orbit import Orbit
from mi_splat.viewer.picking import Picked
from tests.audit.accounts import account, look
from tests.fakes import ColourDetector, register
from tests.project.layers import ROOT
from tests.viewer.exhibits import ball

CAMERA = Orbit(target=(0.1, -0.2, 0.05), azimuth=33.0, elevation=-12.5, distance=4.25, fov=40.0)
MASK, STREET = Path("mask.npy"), ROOT / "scenes" / "car_street.xml"


@pytest.fixture
def exhibit(tmp_path: Path) -> Exhibit:
    save_splat(ball((0.8, 0.1, 0.1)), tmp_path / "ball.ply")
    return replace(exhibit_of_file(tmp_path / "ball.ply"), size=(40, 32))


def request(kind: str, exhibit: Exhibit, **values: Value) -> Request:
    """What a visitor asks for who has chosen some values."""
    mask = torch.arange(len(exhibit.splats[0].scene)) < 15
    fields = {field.name: field.taken(values.get(field.name)) for field in Laboratory().form(kind, exhibit, values)}
    picked = Picked.of(exhibit.splats[0], mask)
    return Request(kind=kind, exhibit=exhibit, orbit=CAMERA, values=fields, picked=picked)


def read_back(wanted: Request) -> Any:
    """The options of the command for a request."""
    name, *words = Laboratory().words(wanted, mask=MASK, out=Laboratory().folder(wanted.kind))
    return cli.parse(name, words)


def test_the_command_of_an_attack_is_that_attack_from_this_camera(exhibit: Exhibit) -> None:
    wanted = request(ATTACK, exhibit, wish="hide", norm="linf", eps=0.3, steps=7.0, detector="yolov8n_small")
    options = read_back(wanted)
    assert wanted.picked is not None
    assert (options.objective, options.target, options.detectors) == ("hide", None, ("yolov8n_small",))
    assert (options.config.norm, options.config.eps, options.config.steps) == ("linf", (0.3,), 7)
    assert (options.scene, options.selection.mask, options.out) == (exhibit.splats[0].path, MASK, Path("out/dagger"))
    (camera,) = find_cameras(open_scene(options.scene), options.view).values()
    assert torch.equal(camera.to_world, CAMERA.camera(exhibit.size).to_world)
    assert (camera.fx, camera.width, camera.height) == (CAMERA.camera((40, 32)).fx, 40, 32)
    loaded = open_scene(STREET)
    street = exhibit_of_file(STREET)
    rear = street.cameras["rear"]
    named = replace(wanted, exhibit=street, orbit=rear, picked=replace(wanted.picked, splat=street.names[0]))
    (camera,) = find_cameras(loaded, read_back(named).view).values()
    assert torch.equal(camera.to_world, loaded.cameras["rear"].to_world)  # to the bit, as the file has it
    relabelled = read_back(request(ATTACK, exhibit, target="stop sign"))
    assert (relabelled.objective, relabelled.target) == ("relabel", "stop sign")


def test_a_judgement_is_from_all_around_by_what_the_attack_wanted(exhibit: Exhibit) -> None:
    values = request(JUDGE, exhibit, wish="relabel", target="person").values
    assert values["success"] == "person"
    assert request(JUDGE, exhibit, wish="hide", target="person").values["success"] == MISSED
    options = read_back(request(JUDGE, exhibit, success="person", cameras=9.0))
    assert (options.clean, options.attacked, options.target) == (*2 * (exhibit.splats[0].path,), "person")
    assert (options.view.cameras, options.view.distance, options.view.centre) == (("hemisphere:9",), 4.25, None)
    assert len(find_cameras(open_scene(options.clean), options.view)) == 9
    assert read_back(request(AUDIT, exhibit)).files == (exhibit.splats[0].path,)
    assert read_back(request(AUDIT, exhibit.turned((0.0, -1.0, 0.0)))).up == (0.0, -1.0, 0.0)


def test_no_object_and_no_other_detector(exhibit: Exhibit) -> None:
    with pytest.raises(InvalidValueError, match="click on one"):
        Laboratory().words(replace(request(ATTACK, exhibit), picked=None), mask=MASK, out=Path("out"))
    usual = Laboratory("yolov8n_small", weights=Path("w.pth"))
    assert usual.form(ATTACK, exhibit, {})[0].usual == "yolov8n_small"
    wanted = replace(request(ATTACK, exhibit), values={**request(ATTACK, exhibit).values, "detector": "yolov8n_small"})
    assert "--weights w.pth" in " ".join(usual.words(wanted, mask=MASK, out=Path("out")))
    assert without(["--a", "-1", "2", "--b", "3", "--c"], "--a", "--c") == ["--b", "3"]


def test_an_audit_leads_to_the_cameras_that_prove_a_look(exhibit: Exhibit, tmp_path: Path) -> None:
    scene, out = exhibit.splats[0].scene, tmp_path / "result"
    write_files(account(look(), count=len(scene)), scene, out, source="elsewhere.ply")
    outcome = Laboratory().opened(request(AUDIT, exhibit), out)
    assert outcome.exhibit is not None
    assert outcome.exhibit.names == ("audited", "heat")
    assert outcome.lines[0].startswith("hidden look")
    assert outcome.cameras["Object 1, look 1"] == outcome.exhibit.cameras["inside"].changed(roll=0.0)
    again = read_back(replace(request(AUDIT, outcome.exhibit), picked=None))  # not of its heat
    assert again.files == (exhibit.splats[0].path,)
    alone = replace(exhibit, splats=(replace(exhibit.splats[0], name="heat"),))  # a file of that name
    assert read_back(request(AUDIT, alone)).files == again.files


def test_a_judgement_colours_directions(exhibit: Exhibit, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(laboratory, "_lines", lambda out: ["what its page says"])
    drawn: dict[str, Any] = {}
    monkeypatch.setattr(laboratory, "draw_domes", drawn.update)
    x, y, z = exhibit.splats[0].scene.means[:15].mean(0).tolist()
    shared = {"detector": "d", "target_score": 0.6, "y": y, "z": z + 3.0}
    rows = [
        {**shared, "splat": splat, "view": view, "x": x + 3.0 * view, "x0": box, "original_score": score}
        for splat, score in (("clean", 0.9), ("attacked", 0.1))
        for view, box in ((0, 1.0), (1, None), (2, 1.0))
    ]
    Looked(rows=frame_of(rows), detections=frame_of([])).write(tmp_path)
    wanted = request(JUDGE, replace(exhibit, splats=_two(exhibit)), success=MISSED)
    outcome = Laboratory().opened(wanted, tmp_path)
    assert outcome.lines[:2] == (
        "clean: missed from 0 of 2 cameras that see it",
        "ball: missed from 2 of 2 cameras that see it",
    )
    assert [success for *_, success in drawn["ball: missed"]] == [True, None, True]
    angles = [elevation for _, elevation, _ in drawn["ball: missed"]]
    assert angles[0] > 60 > angles[1] > angles[2] > 15


def _two(exhibit: Exhibit) -> Any:
    return replace(exhibit.splats[0], name="clean"), exhibit.splats[0]


def test_a_watched_detector_answers_as_the_detector_and_shows_its_boxes() -> None:
    seen: list[Pixels] = []
    detector, picture = ColourDetector(), torch.zeros(1, 32, 32, 3)
    picture[:, 8:24, 8:24, 0] = 1.0
    picture.requires_grad_()
    watched = Watched(detector, seen)
    (expected,), (got,) = detector.candidates(picture), watched.candidates(picture)
    assert torch.equal(got.scores, expected.scores)
    (gradient,) = torch.autograd.grad(got.scores.sum(), picture)
    assert gradient.any()
    assert not np.array_equal(seen[0], (255 * picture[0].detach()).round().byte().numpy())  # a box is drawn
    assert watched.fingerprint == detector.fingerprint


def test_an_attack_tells_how_it_goes_on_and_ends_with_its_best_when_it_is_told_to(
    exhibit: Exhibit, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, variant: str
) -> None:
    register(monkeypatch, {"fake_colour": ColourDetector()})
    wanted = request(ATTACK, exhibit, detector="fake_colour", wish="hide", steps=9.0)
    assert wanted.picked is not None
    (tmp_path / "mask.npy").write_bytes(wanted.picked.file)
    told: list[News] = []
    words = Laboratory().words(wanted, mask=tmp_path / "mask.npy", out=tmp_path / "result")

    def is_step(news: News) -> bool:
        return news.text.startswith("attacking: loss")

    def tell(news: News) -> bool:
        told.append(news)
        return is_step(news)

    perform(words, tell)
    steps = list(filter(is_step, told))
    assert [news.share for news in steps] == [0.1, 0.2]
    assert all(news.picture is not None and news.picture.shape == (32, 40, 3) for news in steps)
    outcome = Laboratory().opened(wanted, tmp_path / "result")
    assert outcome.exhibit is not None
    assert outcome.exhibit.names == ("clean", "attacked")
    assert (tmp_path / "result" / RECORD).is_file()
    assert "Random noise" in outcome.lines[0]
    assert "Warning: The search was stopped after step 1 of 9, before its end." in outcome.lines
    assert "fake_colour" in DETECTORS
