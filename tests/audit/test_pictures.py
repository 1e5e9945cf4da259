"""Sets of pictures: those that show what the others contradict are named, and none of an honest set."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch

from attacks import cli
from attacks.report.results import read_section
from mi_splat.audit import pictures
from mi_splat.audit.pictures import compare_pictures
from mi_splat.audit.surfaces import lattice
from mi_splat.cameras import Camera, View, look_at
from mi_splat.datasets import Dataset, PointCloud, write_transforms
from mi_splat.errors import InvalidValueError
from mi_splat.rendering import Renderer, RenderSettings
from mi_splat.scene import GaussianScene
from tests.audit.scenes import Made, cone, direction, hidden, standing

COUNT, WIDTH = 48, 45.0


@pytest.fixture(scope="module")
def suitcase() -> Made:
    return standing("suitcase", count=1200)


def views_of(scene: GaussianScene) -> list[View]:
    """From all around above the ground."""
    render = Renderer(RenderSettings(background=(0.55, 0.7, 0.9), near=0.05))
    eyes = 2.2 * lattice(COUNT, 8.0, 85.0) + torch.tensor([0.0, 0.0, 0.4])
    cameras = [
        Camera(to_world=look_at(eye.tolist(), (0.0, 0.0, 0.4)), focal=140.0, width=96, height=96) for eye in eyes
    ]
    with torch.no_grad():
        return [View(image=render(scene, camera), camera=camera) for camera in cameras]


@pytest.fixture(scope="module")
def poisoned(suitcase: Made) -> list[View]:
    return views_of(hidden(suitcase, cone(direction(90, 0), WIDTH), colour=(0.8, 0.2, 0.1)).scene)


def test_pictures_that_the_others_contradict_are_named(suitcase: Made, poisoned: list[View]) -> None:
    judged = compare_pictures(poisoned, suitcase.scene, numbers=torch.arange(COUNT))
    assert judged.audit.verdict == "hidden look"
    inside = lattice(COUNT, 8.0, 85.0).float() @ direction(90, 0) > torch.tensor(WIDTH).deg2rad().cos()
    named = torch.zeros(COUNT, dtype=torch.bool)
    named[judged.contradicting] = True
    assert float((named == inside).double().mean()) > 0.8  # SH of degree 3 fade at the edge
    assert float(judged.amounts[inside].median() - judged.amounts[~inside].median()) > 0.5
    assert judged.audit.strongest.occluder is None


def test_an_honest_set_contradicts_nothing(suitcase: Made) -> None:
    judged = compare_pictures(views_of(suitcase.scene), suitcase.scene, numbers=torch.arange(COUNT))
    assert judged.audit.verdict == "nothing found"
    assert judged.contradicting == []
    with pytest.raises(InvalidValueError, match="cameras: expected at least 12, got 5"):
        compare_pictures(views_of(suitcase.scene)[:5], suitcase.scene, numbers=torch.arange(5))


def test_the_command_takes_a_folder_of_pictures(
    suitcase: Made,
    poisoned: list[View],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Its surface is known here already: a training has tests of its own."""
    colours = torch.full_like(suitcase.scene.means, 0.5)
    write_transforms(tmp_path / "set", poisoned, points=PointCloud(suitcase.scene.means, colours))

    def surface(views: Dataset, on_step: object) -> GaussianScene:
        if views.downscale > 1:
            raise InvalidValueError(f"{views.downscale} times smaller")
        return suitcase.scene

    monkeypatch.setattr(pictures, "quick_surface", surface)
    out = tmp_path / "out"
    assert cli.main(["audit", str(tmp_path / "set"), "--out", str(out)]) == 3
    record = json.loads((out / "result.json").read_text())
    assert len(record["views"]) == COUNT
    named = [view for view in record["views"] if view["contradicts"]]
    assert record["summary"][-1].startswith(f"{len(named)} of {COUNT} pictures show what the others contradict")
    assert {file.name for file in out.iterdir()} == {"result.json", "manifest.json", "pair.png"}
    section = read_section(out)
    assert section.kind == "audit of pictures"
    assert len(section.tables[-1].rows) == len(named)
    assert cli.main(["audit", str(tmp_path / "set"), "--cameras", "orbit:20@20"]) == 2
    assert cli.main(["audit", str(tmp_path / "set"), "--downscale", "2"]) == 1
    assert "2 times smaller" in capsys.readouterr().err
    monkeypatch.setattr(pictures, "MOST_CAMERAS", COUNT - 1)
    capsys.readouterr()
    cli.main(["audit", str(tmp_path / "set"), "--out", str(out), "--force"])
    assert f"{COUNT - 1} of the {COUNT} pictures of the set were compared" in capsys.readouterr().out
    assert any(f"{COUNT - 1} of the {COUNT} pictures" in warning for warning in read_section(out).warnings)
