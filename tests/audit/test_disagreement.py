"""What detectors report along paths of cameras: where a class goes away and comes back."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from torch import Tensor

from attacks import cli
from attacks.audits.disagreement import AROUND, OVER, Seen, seen_along_paths
from attacks.detectors.base import Candidates, Detections
from mi_splat.io import save_splat
from tests.audit.scenes import Made, cone, direction, hidden, standing
from tests.fakes import register


class Reddest:
    """Reports a car around all that is clearly red."""

    name: str = "reddest"
    classes: tuple[str, ...] = ("car",)
    fingerprint: str = "0" * 16
    min_confidence: float = 0.0

    def candidates(self, images: Tensor) -> list[Candidates]:
        raise AssertionError("only detections are asked for")

    def detect(self, images: Tensor) -> list[Detections]:
        return [self._found(image) for image in images]

    def _found(self, image: Tensor) -> Detections:
        places = (image[..., 0] > image[..., 1] + 0.3).nonzero().float()
        if len(places) < 50:
            return Detections(torch.zeros(0, 4), torch.zeros(0), ())
        (y0, x0), (y1, x1) = places.amin(0).tolist(), places.amax(0).tolist()
        return Detections(torch.tensor([[x0, y0, x1, y1]]), torch.tensor([0.9]), ("car",))


@pytest.fixture(scope="module")
def red() -> Made:
    return standing("suitcase", count=900).with_colours(
        lambda own, normals, views: torch.tensor([0.8, 0.1, 0.1]).expand(len(views), len(own), 3), degree=3
    )


def seen(made: Made) -> dict[str, Seen]:
    return {one.path: one for one in seen_along_paths(made.scene, [Reddest()]) if one.number == 1}


def test_a_class_that_goes_away_and_comes_back_is_seen(red: Made) -> None:
    looks = seen(hidden(red, cone(direction(90, 0), 50)))
    assert looks[OVER].runs == ["car", "nothing", "car"]
    assert looks[OVER].comes_back
    assert looks[AROUND].runs == ["car"]
    assert {path: one.runs for path, one in seen(red).items()} == {AROUND: ["car"], OVER: ["car"]}
    assert not any(one.comes_back for one in seen(red).values())


def test_the_page_of_an_audit_shows_it(
    red: Made, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    register(monkeypatch, {"reddest": Reddest()})
    save_splat(red.scene, tmp_path / "red.ply")
    assert cli.main(["audit", str(tmp_path / "red.ply"), "--only", "looks", "--out", str(tmp_path / "out")]) in (0, 3)
    words = ["report", str(tmp_path / "out"), "--detectors", "reddest", "--out", str(tmp_path / "page.html")]
    assert cli.main(words) == 0
    page = (tmp_path / "page.html").read_text()
    assert "Along paths of cameras" in page
    assert f"reddest {AROUND}" in page
    (tmp_path / "red.ply").unlink()
    assert cli.main([*words, "--force"]) == 1
    assert "whose splat is there" in capsys.readouterr().err
