"""`study = "audit"`: what counts as hiding something, that a control counts once, and the figures of what is found."""

import json
import re
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import pytest

from attacks import cli
from attacks.audits import audited
from attacks.cloak.study import study_toml
from attacks.detectors import registry
from attacks.report.results import read_section
from attacks.studies.audit import AuditWork, figures, tables
from attacks.studies.study_file import study_of
from mi_splat.io import save_splat
from tests.audit.scenes import cone, direction, hidden, standing
from tests.cloak.tiny_study import KNOWN, STUDY
from tests.project.layers import ROOT


def test_a_control_that_attacks_share_counts_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(ROOT)
    monkeypatch.setattr("attacks.studies.audit.detectors_of", lambda config, weights: [])
    kinds = [{"name": "above"}, {"name": "side", "attack": {"hidden": {"elevation": [0, 35], "azimuth": [100, 40]}}}]
    table = {"study": "audit", "base": "scenes/audit_base.toml", "matrix": {"kind": kinds}, "chosen_on": ["tv"]}
    work = AuditWork(study_of(table, "x"))
    assert [(one.part, one.splat) for one in work.audited] == [
        ("above", "clean"),
        ("above", "cloaked"),
        ("side", "cloaked"),
    ]


def row(part: str, splat: str, evidence: float, *, hides: bool = False, content: str = "tv") -> dict[str, Any]:
    """A row of a result."""
    told = {
        "part": part,
        "value": "x",
        "content": content,
        "splat": splat,
        "hides": hides,
        "missed": {},
        "derived": part == "cleaned",
    }
    measured = {"verdict": "suspicious", "evidence": evidence, "excess": 0.01, "occluder": 0.0, "gaussians": 9}
    measured |= {"scores": {"band 1": -evidence}}
    return {**told, **measured, **({"directions": evidence / 4} if splat == "cloaked" else {})}


def test_figures_count_what_hides_and_leave_out_what_was_chosen_on() -> None:
    rows = [
        row("above", "cloaked", 2.0, hides=True),
        row("above", "cloaked", 0.5, hides=True),
        row("sector", "cloaked", 1.0, hides=True),
        row("sector", "cloaked", 0.0),  # a failed attack
        row("cleaned", "cloaked", 0.3, hides=True),
        row("cleaned", "clean", 7.0),
        row("above", "cloaked", 0.0, hides=True, content="car"),
        row("above", "clean", 0.6),
        row("scenes", "honest", 1.5),
        row("scenes", "honest", 0.1),
        row("scenes", "clean", 9.0, content="car"),
    ]
    told = figures(rows, ["car"])
    assert told["honest"] == 3
    assert told["false_alarms"]["successes"] == 1
    parts = told["parts"]
    assert {name: (one["found"]["successes"], one["found"]["total"]) for name, one in parts.items()} == {
        "all": (2, 3),
        "above": (1, 2),
        "sector": (1, 1),
        "cleaned": (0, 1),
    }
    assert parts["all"]["auroc"] == pytest.approx((3 + 1 + 2) / 9)
    low, high = parts["all"]["interval"]
    assert 0 <= low <= parts["all"]["auroc"] <= high <= 1
    assert parts["all"]["directions"] == pytest.approx(0.25)
    first, others, hiding, honest, failed = tables({"figures": told, "chosen_on": ["car"], "files": rows})
    assert first.rows[0][0] == "all"
    assert [line[0] for line in others.rows] == ["the audit", "band 1"]
    assert told["rivals"]["band 1"] == pytest.approx(1 - parts["all"]["auroc"])
    assert (len(hiding.rows), len(honest.rows), len(failed.rows)) == (5, 5, 1)


def test_the_figures_of_the_documentation_follow_from_its_files() -> None:
    record = json.loads((ROOT / "docs" / "tables" / "audit.json").read_text())
    told = figures(record["files"], record["chosen_on"])
    page = (ROOT / "docs" / "audit-measured.md").read_text()
    for name, part in told["parts"].items():
        counted, (low, high) = part["found"], part["interval"]
        shown = name if name != "all" else "**all, without the cleaned**"
        rate = f"{counted['successes']} of {counted['total']}"
        line = f"| {shown} | {rate} | {part['auroc']:.3f} ({low:.3f} to {high:.3f}) |"
        assert line in page, name
    assert told["false_alarms"]["successes"] == 1
    assert told["honest"] == 35
    for name, value in told["rivals"].items():
        assert f"| {name} | {value:.3f} |" in page


@pytest.mark.nightly
def test_a_study_is_done_and_has_a_page(tmp_path: Path) -> None:
    """Files are audited; a scene is photographed first, and of a cloaked splat it is asked whether it hides."""
    save_splat(hidden(standing("car", count=1500), cone(direction(90, 0), 50)).scene, tmp_path / "hidden.ply")
    cameras = replace(STUDY.cameras, train=48, samples=16)  # a clean splat of 16 pictures may look different by chance
    better = replace(STUDY, cameras=cameras, training=replace(STUDY.training, iterations=300))
    base = {**asdict(better), "attack": [asdict(STUDY.attack[0])]}
    (tmp_path / "base.toml").write_text(study_toml(base))
    file = tmp_path / "tiny.toml"
    file.write_text(
        f'study = "audit"\nbase = "{tmp_path / "base.toml"}"\nchosen_on = ["suitcase"]\n'
        '[[case]]\nname = "files"\n[case.matrix]\n'
        f'file = ["{tmp_path / "hidden.ply"}"]\n'
        '[[case]]\nname = "scenes"\nexposure = 0.3\ncameras = { distance = 5.5 }\n'
        f'capture = "{ROOT / "scenes" / "honest" / "still_life.xml"}"\n'
        '[[case]]\nname = "above"\n'
    )
    out = tmp_path / "out"
    words = ["study", "run", str(file), "--store", str(tmp_path / "store"), "--out", str(out), "--workers", "0"]
    cheap = patch.object(audited, "measured", lambda scene: {"band 1": (0.1, 0.0)})
    with patch.dict(registry.DETECTORS.own, KNOWN), cheap:
        assert cli.main(words) == 0
    record = json.loads((out / "result.json").read_text())
    files = {(one["part"], one["splat"]): one for one in record["files"]}
    assert set(files) == {("files", "honest"), ("scenes", "honest"), ("above", "clean"), ("above", "cloaked")}
    assert files["files", "honest"]["evidence"] > 1 > files["above", "clean"]["evidence"]
    cloaked = files["above", "cloaked"]
    (missed,) = cloaked["missed"].values()
    assert cloaked["hides"] is (missed["total"] > 0 and missed["successes"] >= missed["total"] / 2)
    assert 0 <= cloaked["directions"] <= 1
    assert [path.name for path in (out / "pairs").iterdir() if "hidden" in path.name]
    section = read_section(out)
    assert re.search(r"\d of \d|nothing counted", section.control.value if section.control else "")
    assert "4 splats were audited" in section.done
