"""A folder or a file of every kind of result that a page can show, by the command that writes it."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

from attacks.cli import main
from attacks.dagger.eot.tables import write_eot_tables
from attacks.dagger.report import write_report
from attacks.dagger.sanity.checks import Finding, write_findings
from attacks.dagger.sanity.runs import Runs
from attacks.dagger.study import run_jobs
from attacks.dagger.transfer import tables as transfer_tables
from attacks.dagger.transfer.study import run_transfer
from mi_splat import provenance
from mi_splat.io import save_splat
from mi_splat.io.camera_records import describe
from mi_splat.io.documents import save_json
from tests.dagger import test_sanity, test_transfer
from tests.dagger.eot import test_study as eot_study
from tests.dagger.toy import quick
from tests.fakes import camera, toy_scene
from tests.project.documented_commands import ROOT
from tests.report.further_results import FURTHER
from tests.report.results import change, rate, write_cloak, write_dagger, write_evaluation, write_variations


def write_eot(folder: Path) -> Path:
    write_report(quick(), folder)
    change(folder / "result.json", scene="toy.xml", selection={"object": "thing"}, cameras=["front"])
    return folder


def write_eot_study(folder: Path) -> Path:
    one, setup = eot_study.runner(), eot_study.SETUP
    jobs = [setup.job("smallest", eps=(radius,)) for radius in (0.01, 2.0)]
    jobs += [setup.job("curve", eps=(radius,)) for radius in (0.05, 2.0)]
    write_eot_tables(run_jobs(jobs, folder, one.run, fingerprint=one.fingerprint), folder)
    return folder


def write_transfer(folder: Path) -> Path:
    judges = list(test_transfer.DETECTORS)
    records = run_transfer(test_transfer.JOBS[:3], judges, folder, test_transfer.runner(folder))
    transfer_tables.write_tables(records, folder)
    return folder


def write_rendering_study(folder: Path) -> Path:
    """By hand: the runs of tests/rendering_studies need renderers of their own."""
    folder.mkdir()
    group = {"detector": "a", "renderer": "tile", "gradient": "own", "attribute": "sh", "sh_degree": 3}
    group = {**group, "norm": "l2", "eps": 5.0}
    outcomes = [
        {
            **{**group, "condition": condition, "target_confidence": 0.6, "found": rate(found, 12)},
            **{"targeted": rate(hits, found), "untargeted": rate(hits, found)},
            **{"noise_targeted": rate(0, found), "noise_untargeted": rate(1, found)},
        }
        for condition, found, hits in (("tile", 12, 11), ("ray", 10, 3), ("07:00", 4, 0))
    ]
    document = {
        **{"study": "toy", "question": "Does it survive?", "toml": "name = 'toy'\n", "attacks": 12},
        **{
            "configuration": {"seeds": 3, "detectors": ["a"]},
            "outcomes": outcomes,
            "image_psnr": [{**group, "psnr": 31.2}],
        },
        "weights": {"a": "0123"},
    }
    save_json({**document, **provenance.origin()}, folder / "study.json")
    return folder


def write_held_out(folder: Path) -> Path:
    folder.mkdir()
    four = {name: rate(n, 40) for name, n in (("targeted", 8), ("untargeted", 20), ("noise_targeted", 0))}
    cell = {**four, "noise_untargeted": rate(4, 40), "sources": ["a"], "runs": 40}
    cells = [{**cell, "detector": "a", "white_box": True}, {**cell, "detector": "b", "white_box": False}]
    origin = {"study": "out/study", "scenes": "elsewhere", "views": 12, "weights": {"a": "0123"}}
    save_json({"cells": cells, **origin, **provenance.origin()}, folder / "held_out.json")
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


def write_new_study(folder: Path) -> Path:
    """A study that was done: the six pairs from all cameras."""
    shutil.copytree(ROOT / "docs" / "artifacts" / "dagger_eot_pairs", folder)
    change(folder / "result.json", command=provenance.command(), question="From everywhere?")
    return folder


MAKERS: dict[str, Callable[[Path], Path]] = {
    "study": write_new_study,
    "dagger": write_dagger,
    "dagger-eot": write_eot,
    "cloak": write_cloak,
    "cloak --vary": write_variations,
    "dagger-eot-study": write_eot_study,
    "dagger-transfer": write_transfer,
    "dagger-transfer --eot-study": write_held_out,
    "rendering-study": write_rendering_study,
    "dagger-sanity": write_sanity,
    "evaluate": write_evaluation,
    "compare": write_comparison,
    **FURTHER,
}
