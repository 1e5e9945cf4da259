"""Scoring again needs the splats, cameras.json and a detector."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
import torch
from torch import Tensor

from attacks import cli
from attacks.artifacts.checking import check_artifact
from attacks.artifacts.packing import pack_artifact
from attacks.artifacts.rescoring import rescore
from attacks.cli import artifact_check
from attacks.detectors.base import Detections
from mi_splat.errors import InvalidValueError
from tests.cloak.tiny_study import Redness


class Blind(Redness):
    """Reports nothing."""

    def detect(self, images: Tensor) -> list[Detections]:
        return [Detections(torch.zeros(0, 4), torch.zeros(0), ()) for _ in images]


class Other(Redness):
    """A detector that no study has seen."""

    name = "other"


def test_the_same_detector_gives_the_same_rates(packed: Path) -> None:
    looked: list[tuple[int, int]] = []
    lines = rescore(check_artifact(packed), [Redness()], on_view=lambda done, total: looked.append((done, total)))
    assert {line.colour for line in lines} == {"green"}
    assert all("moved by 0.0%" in line.words for line in lines)
    assert looked[-1][0] == looked[-1][1] == len(looked)


def test_a_detector_that_sees_otherwise_is_red(packed: Path) -> None:
    lines = rescore(check_artifact(packed), [Blind()], every=4)
    assert "red" in {line.colour for line in lines}
    assert all(line.passed for line in rescore(check_artifact(packed), [Blind()], every=4, rate_tolerance=1.0))


def test_another_detector_has_nothing_to_be_compared_with(packed: Path) -> None:
    lines = rescore(check_artifact(packed), [Other()], every=4)
    assert {line.colour for line in lines} == {"grey"}
    assert all(line.name.startswith("other, ") for line in lines)


def test_splats_may_lie_elsewhere_and_are_known_by_their_hash(result: Path, packed: Path, tmp_path: Path) -> None:
    pack_artifact(result, tmp_path / "small")
    small = check_artifact(tmp_path / "small")
    with pytest.raises(InvalidValueError, match="expected a splat of the artifact, got none") as error:
        rescore(small, [Redness()])
    assert error.value.hint == "--splats"
    for place in (result, packed / "splats"):
        assert all(line.passed for line in rescore(small, [Redness()], splats=place, every=8))
    shutil.copytree(packed / "splats", tmp_path / "swapped")
    shutil.copyfile(tmp_path / "swapped" / "clean_0.ply", tmp_path / "swapped" / "cloaked_0.ply")
    with pytest.raises(InvalidValueError, match=r"expected the cloaked splat, seed 0 .* got another"):
        rescore(small, [Redness()], splats=tmp_path / "swapped")


@pytest.mark.parametrize(
    ("key", "value"),
    [("cameras", []), ("cameras", [{}]), ("near", "x"), ("near", -1), ("background", [1]), ("background", None)],
)
def test_broken_cameras_are_refused(key: str, value: object, artifact: Path) -> None:
    path = artifact / "cameras.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), key: value}))
    with pytest.raises(InvalidValueError, match=r"cameras\.json: expected .* get the artifact again"):
        rescore(check_artifact(artifact), [Redness()])


def test_the_command_scores_again(
    packed: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(artifact_check, "load_detectors", lambda names, weights: [Redness()])
    assert cli.main(["artifact-check", str(packed), "--rescore", "--every", "8"]) == 0
    assert "moved by 0.0%, may move by 2.0%" in capsys.readouterr().out
    monkeypatch.setattr(artifact_check, "load_detectors", lambda names, weights: [Blind()])
    assert cli.main(["artifact-check", str(packed), "--rescore", "--every", "8"]) == 1
