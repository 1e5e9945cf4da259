"""The record of an attack on a distribution of views: the attack is repeated from it, and its splat is scored again."""

from __future__ import annotations

import json
import shlex
from pathlib import Path
from typing import Any

import pytest

from attacks import cli
from attacks.observe.views import object_boxes
from attacks.report.checking import pack, read_result
from attacks.report.exhibits import open_exhibit
from attacks.report.rescoring import rescore
from attacks.report.results import read_section, story_of
from mi_splat.errors import InvalidValueError
from mi_splat.io import load_splat, save_splat
from mi_splat.io.camera_records import camera_of, recorded_cameras
from mi_splat.rendering import Renderer, RenderSettings
from tests.fakes import CoarseDetector, ColourDetector, toy_scene

WORDS = (
    "--box -0.5 -0.5 -0.5 0.5 0.5 0.5 --azimuth 270 --elevation 0 --distance 3 --size 32 --fov 45 --near 0.3 "
    "--background 0.1 0.1 0.12 --azimuths 250 290 --elevations 0 20 --exposure 0.2 --eps 2 --steps 6 --step-factor 4 "
    "--pool 6 --validation 2 --held-out 4 --image-psnr None"
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory, variant: str) -> Path:
    """What the command leaves behind."""
    base = tmp_path_factory.mktemp("eot")
    save_splat(toy_scene()[0], base / "a.ply")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("attacks.cli.names.load_detectors", lambda names, weights: [ColourDetector()])
        assert cli.main(["dagger-eot", str(base / "a.ply"), *WORDS.split(), "--out", str(base / "out")]) == 0
    return base / "out"


def stored(folder: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((folder / "result.json").read_text())
    return found


def test_the_command_is_stored_and_repeats_it(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before, line = stored(folder), read_section(folder).command
    program, *words = shlex.split(line)
    assert [program, *words] == [
        "mi-splat",
        "dagger-eot",
        str(folder.parent / "a.ply"),
        *WORDS.split(),
        "--out",
        str(folder),
    ]
    monkeypatch.setattr("attacks.cli.names.load_detectors", lambda names, weights: [ColourDetector()])
    assert cli.main([*words[:-1], f"{folder}-again"]) == 0
    after = stored(Path(f"{folder}-again"))
    assert {key: after[key] for key in after if key not in ("seconds", "command")} == {
        key: before[key] for key in before if key not in ("seconds", "command")
    }


def test_it_holds_all_that_its_pictures_depend_on(folder: Path) -> None:
    values = stored(folder)
    assert (values["near"], values["background"]) == (0.3, [0.1, 0.1, 0.12])
    settings = RenderSettings(near=values["near"], background=tuple(values["background"]))
    cameras = [camera_of(view["camera"]) for view in values["views"]]
    boxes = object_boxes(toy_scene()[0], toy_scene()[1], cameras, render=Renderer(settings))
    assert [None if box is None else box.tolist() for box in boxes] == [view["box"] for view in values["views"]]
    assert len(values["views"][0]["noise_successes"]) == values["config"]["noise_draws"]
    reference = recorded_cameras(folder / "result.json")
    assert reference is not None
    assert list(reference) == ["orbit"]
    assert recorded_cameras(folder / "result.json", reference=False) is None


def test_its_copy_is_scored_again(folder: Path, tmp_path: Path) -> None:
    story = story_of(read_result(folder))
    copy = pack(folder, tmp_path / "copy", story.figures, whole=True)
    lines = rescore(copy, story.rescoring, [ColourDetector()])
    assert [line.colour for line in lines] == ["green", "green"]
    assert all("moved by 0.0%" in line.words for line in lines)
    assert {line.colour for line in rescore(copy, story.rescoring, [CoarseDetector()], every=2)} == {"grey"}

    class Blind(ColourDetector):
        min_confidence = 2.0

    looked: list[tuple[int, int]] = []
    lines = rescore(copy, story.rescoring, [Blind()], every=2, on_view=lambda done, total: looked.append((done, total)))
    assert lines[0].colour == "red"
    assert looked == [(1, 2), (2, 2)]


def test_the_splat_may_lie_elsewhere_and_is_known_by_its_hash(folder: Path, tmp_path: Path) -> None:
    story = story_of(read_result(folder))
    copy = pack(folder, tmp_path / "copy", story.figures)
    with pytest.raises(InvalidValueError, match="expected a splat of the result, got none") as error:
        rescore(copy, story.rescoring, [ColourDetector()])
    assert error.value.hint == "--splats"
    assert all(line.passed for line in rescore(copy, story.rescoring, [ColourDetector()], splats=folder))
    save_splat(toy_scene()[0], tmp_path / "attacked.ply")
    with pytest.raises(InvalidValueError, match=r"expected the SHA-256 that the manifest lists of attacked\.ply"):
        rescore(copy, story.rescoring, [ColourDetector()], splats=tmp_path)


def test_its_held_out_views_are_shown(folder: Path) -> None:
    found = open_exhibit(folder, clean=folder.parent / "a.ply")
    assert [name for name in found.cameras if "view" in name] == [f"held-out view {i}" for i in range(4)]
    assert set(found.lines) == {"Held-out cameras"}
    assert (found.settings.near, found.settings.background) == (0.3, (0.1, 0.1, 0.12))
    assert len(load_splat(folder / "attacked.ply")) == len(found.splat("attacked").scene)
