"""A folder or a file of every kind of result that a page can show, by the command that writes it."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

from attacks.cli import main
from attacks.dagger.report import write_report
from attacks.dagger.sanity.checks import Finding, write_findings
from attacks.dagger.sanity.runs import Runs
from mi_splat import provenance
from mi_splat.io import save_splat
from mi_splat.io.camera_records import describe
from tests.dagger import test_sanity
from tests.dagger.toy import quick
from tests.fakes import camera, toy_scene
from tests.project.documented_commands import ROOT
from tests.report.further_results import FURTHER
from tests.report.results import change, write_cloak, write_dagger, write_evaluation, write_variations


def write_eot(folder: Path) -> Path:
    write_report(quick(), folder)
    change(folder / "result.json", scene="toy.xml", selection={"object": "thing"}, cameras=["front"])
    return folder


def write_sanity(folder: Path) -> Path:
    folder.mkdir()
    findings = [
        Finding(name=name, claim=name, passed=passed, figures="0.5", meaning="it is broken", values={})
        for name, passed in (("clean", True), ("noise", False), ("white_box", None))
    ]
    found = {"selection": {"object": "thing"}, "cameras": [describe("front", camera())]}
    write_findings(findings, Runs(test_sanity.case()), folder, scene="toy.xml", near=0.3, background=[0, 0, 1], **found)
    return folder


def write_comparison(folder: Path) -> Path:
    save_splat(toy_scene()[0], folder.parent / "toy.ply")
    words = ["compare", str(folder.parent / "toy.ply"), "--size", "16", "--rounds", "1", "--out", str(folder)]
    assert main(words) == 0
    return folder


def write_study(folder: Path) -> Path:
    """A study that was done: the six pairs from all cameras."""
    shutil.copytree(ROOT / "docs" / "artifacts" / "dagger_eot_pairs", folder)
    change(folder / "result.json", command=provenance.command(), question="From everywhere?")
    return folder


MAKERS: dict[str, Callable[[Path], Path]] = {
    "study": write_study,
    "dagger": write_dagger,
    "dagger-eot": write_eot,
    "cloak": write_cloak,
    "cloak-study": write_variations,
    "dagger-sanity": write_sanity,
    "evaluate": write_evaluation,
    "compare": write_comparison,
    **FURTHER,
}
