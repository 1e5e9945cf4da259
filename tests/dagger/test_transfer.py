"""Transfer on fakes: what is attacked, what is judged and not done twice, and what the matrix counts."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import pytest
import torch

from attacks import cli
from attacks.cli import dagger_transfer
from attacks.dagger.config import DaggerConfig, EotConfig
from attacks.dagger.eot.jobs import EotJob, EotJobRunner
from attacks.dagger.study import PAIRS, run_jobs
from attacks.dagger.transfer.heat_map import draw_heat_maps
from attacks.dagger.transfer.held_out import HeldOutRunner, held_out_jobs, run_held_out
from attacks.dagger.transfer.jobs import JudgeJob, SourceJob, TransferRunner, transfer_jobs
from attacks.dagger.transfer.matrix import attacked, cells, left_out, looked_rows, noise, title
from attacks.dagger.transfer.study import run_transfer
from attacks.dagger.transfer.tables import markdown, write_tables
from attacks.detectors.base import Detector
from attacks.transformations.config import CameraRegion, Transformations
from mi_splat.errors import InvalidValueError
from mi_splat.io import load_splat, save_splat
from tests.dagger.test_study import toy
from tests.fakes import CoarseDetector, ColourDetector, register


class Blind(ColourDetector):
    """Reports nothing, whatever it sees."""

    name = "fake_blind"
    min_confidence = 2.0


DETECTORS: dict[str, Detector] = {one.name: one for one in (ColourDetector(), CoarseDetector(), Blind())}
SEEING = ("fake_colour", "fake_coarse")
CONFIG = DaggerConfig(eps=(12.0,), early_stop=False, noise_draws=0, steps=4)


def job(*sources: str, seed: int = 0) -> SourceJob:
    config = dataclasses.replace(CONFIG, seed=seed)
    return SourceJob(sources=sources, scene="toy", object="thing", target="person", config=config)


def runner(out: Path) -> TransferRunner:
    return TransferRunner(lambda name: renamed(), DETECTORS.__getitem__, out)


def renamed() -> Any:
    """The toy scene; its object is called by the class that the fakes see in it."""
    place = toy()
    return dataclasses.replace(place, objects={"thing": place.objects["thing"], "car": place.objects["thing"]})


JOBS = [
    dataclasses.replace(job(*sources, seed=seed), object="car")
    for seed in (0, 1)
    for sources in (("fake_colour",), ("fake_coarse",), SEEING)
]


@pytest.fixture(scope="module")
def study(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[dict[str, Any]]]:
    out = tmp_path_factory.mktemp("transfer")
    return out, run_transfer(JOBS, list(DETECTORS), out, runner(out))


def test_the_study_attacks_each_detector_and_all_but_one() -> None:
    jobs = transfer_jobs(("a", "b", "c"), seeds=2, eps=3.0, steps=7)
    assert len({one.name for one in jobs}) == len(jobs) == 2 * 6 * len(PAIRS)
    assert {one.sources for one in jobs} == {("a",), ("b",), ("c",), ("b", "c"), ("a", "c"), ("a", "b")}
    assert {(one.scene, one.object, one.target) for one in jobs} == set(PAIRS)
    assert [one.config.seed for one in jobs] == [0] * 36 + [1] * 36
    assert {(one.config.eps, one.config.steps, one.config.early_stop) for one in jobs} == {((3.0,), 7, False)}
    assert {one.sources for one in transfer_jobs(("a", "b"), seeds=1, eps=3.0, steps=7)} == {("a",), ("b",)}
    assert len(transfer_jobs(("a", "b", "c"), seeds=1, eps=3.0, steps=7, ensembles=False)) == 18
    assert transfer_jobs(("a",), seeds=1, eps=3.0, steps=7)[3].original == "stop sign"


def test_a_judge_sees_what_the_attack_left(study: tuple[Path, list[dict[str, Any]]]) -> None:
    out, records = study
    first = records[0]
    seen = first["judged"]["fake_colour"]
    assert first["attack"]["target_confidence"] == pytest.approx(seen["attacked"]["target_score"], abs=1e-6)
    assert seen["clean"]["original_score"] > 0.9 > 0.1 > seen["clean"]["target_score"]
    assert seen["attacked"]["target_score"] > 0.5 > seen["attacked"]["original_score"]
    assert seen["noise"]["original_score"] > 0.5 > seen["noise"]["target_score"]
    blind = first["judged"]["fake_blind"]["clean"]
    assert (blind["label"], blind["score"], blind["original_score"], blind["target_score"]) == (None, 0.0, 0.0, 0.0)
    part = load_splat(out / "attacked" / f"{JOBS[0].name}.ply")
    assert (len(part), part.degree) == (30, 3)
    assert not torch.equal(part.sh[:, :4], toy().scene.sh[10:])


def test_what_is_done_is_not_done_again_and_a_new_judge_needs_no_attack(tmp_path: Path) -> None:
    one = runner(tmp_path)
    run_transfer(JOBS[:1], ["fake_colour"], tmp_path, one)
    attacks: list[str] = []
    heard: list[str] = []

    class Counting(TransferRunner):
        def attack(self, job: SourceJob) -> dict[str, Any]:
            attacks.append(job.name)
            return super().attack(job)

    again = Counting(lambda name: renamed(), DETECTORS.__getitem__, tmp_path)
    (record,) = run_transfer(JOBS[:1], ["fake_colour", "fake_blind"], tmp_path, again, on_job=heard.append)
    assert attacks == []
    assert heard == [JOBS[0].name]
    assert set(record["judged"]) == {"fake_colour", "fake_blind"}
    again.path(JOBS[0]).unlink()
    run_transfer(JOBS[:1], ["fake_colour"], tmp_path, again)
    assert attacks == [JOBS[0].name]


def test_fingerprints_follow_the_detectors_that_play_a_part(tmp_path: Path) -> None:
    class Retrained(CoarseDetector):
        fingerprint = "another"

    before = runner(tmp_path)
    after = TransferRunner(lambda name: renamed(), {**DETECTORS, "fake_coarse": Retrained()}.__getitem__, tmp_path)
    alone, by_other = JOBS[0], JudgeJob(source=JOBS[0], detector="fake_coarse")
    assert before.attack_fingerprint(alone) == after.attack_fingerprint(alone)
    assert before.attack_fingerprint(JOBS[1]) != after.attack_fingerprint(JOBS[1])
    assert before.judge_fingerprint(by_other) != after.judge_fingerprint(by_other)


def test_a_splat_that_was_made_anew_is_judged_anew(tmp_path: Path) -> None:
    one = runner(tmp_path)
    run_transfer(JOBS[:1], ["fake_colour"], tmp_path, one)
    judged: list[str] = []

    class Counting(TransferRunner):
        def judge(self, job: JudgeJob) -> dict[str, Any]:
            judged.append(job.name)
            return super().judge(job)

    again = Counting(lambda name: renamed(), DETECTORS.__getitem__, tmp_path)
    run_transfer(JOBS[:1], ["fake_colour"], tmp_path, again)
    assert judged == []
    path = again.path(JOBS[0])
    part = load_splat(path)
    save_splat(part.replace(opacities=part.opacities * 0.5), path)
    run_transfer(JOBS[:1], ["fake_colour"], tmp_path, again)
    assert len(judged) == 1


def test_the_matrix_counts_runs_whose_clean_object_is_found(study: tuple[Path, list[dict[str, Any]]]) -> None:
    _, records = study
    matrix = {(cell.sources, cell.detector): cell for cell in cells(looked_rows(records))}
    assert len(matrix) == 9
    own = matrix[("fake_colour",), "fake_colour"]
    assert (own.targeted.successes, own.targeted.total, own.white_box) == (2, 2, True)
    assert own.noise_targeted.successes == own.noise_untargeted.successes == 0
    blind = matrix[("fake_colour",), "fake_blind"]
    assert (blind.targeted.total, blind.runs, blind.white_box) == (0, 2, False)
    assert noise(list(matrix.values()), "fake_coarse", "targeted").total == 6


def made_up(sources: tuple[str, ...], judged: dict[str, tuple[float, float, float]]) -> dict[str, Any]:
    """A record; of each judge its clean and attacked confidence in the object, and in the target after the attack."""
    seen = {
        name: {
            "clean": {"original_score": clean, "target_score": 0.0},
            "attacked": {"original_score": original, "target_score": target},
            "noise": {"original_score": clean, "target_score": 0.0},
        }
        for name, (clean, original, target) in judged.items()
    }
    return {"job": {"sources": list(sources)}, "judged": seen}


def test_leave_one_out_is_beside_the_best_single_source() -> None:
    records = [
        made_up(("a", "b"), {"c": (0.9, 0.2, 0.6), "a": (0.9, 0.1, 0.9)}),
        made_up(("a", "b"), {"c": (0.4, 0.2, 0.9), "a": (0.9, 0.1, 0.9)}),  # c does not find the clean object
        made_up(("a",), {"c": (0.9, 0.9, 0.4), "b": (0.9, 0.9, 0.0)}),
        made_up(("b",), {"c": (0.9, 0.49, 0.0), "b": (0.9, 0.1, 0.9)}),
        made_up(("c",), {"c": (0.9, 0.1, 0.9), "only_judges": (0.9, 0.9, 0.0)}),
    ]
    assert attacked(cells(looked_rows(records))) == ["a", "b", "c"]
    (row,) = left_out(cells(looked_rows(records)))
    assert row["detector"] == "c"
    assert (row["ensemble"]["targeted"]["successes"], row["ensemble"]["targeted"]["total"]) == (1, 1)
    assert row["ensemble"]["runs"] == 2
    assert row["best_single_targeted"]["targeted"]["successes"] == 0
    assert row["best_single_untargeted"]["sources"] == ["b"]
    assert title(("a", "b"), ["a", "b", "c"]) == "all but c"
    assert title(("a", "b"), ["a", "b", "c", "d"]) == "a + b"


def test_tables_and_picture_are_written(study: tuple[Path, list[dict[str, Any]]], tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    _, records = study
    paths = write_tables(records, tmp_path)
    assert [path.name for path in paths] == ["transfer.md", "transfer.json", "transfer.png"]
    text = paths[0].read_text()
    assert text == markdown(records)
    assert "| fake_colour | 2/2 (0.34 to 1.00) * |" in text
    assert "| random noise | 0/6 (0.00 to 0.39) | 0/6 (0.00 to 0.39) | 0/0 |" in text
    values = json.loads(paths[1].read_text())
    assert len(values["cells"]) == 9
    assert values["weights"]["fake_coarse"] == [CoarseDetector.fingerprint]
    assert paths[2].read_bytes().startswith(b"\x89PNG")
    assert draw_heat_maps(cells(looked_rows(records)), tmp_path / "again.png")


def test_the_command_takes_what_can_be_loaded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    known = {"fake_colour": Spec(""), "other_colour": Spec("its file is missing"), "fake_blind": Spec("")}
    monkeypatch.setattr(dagger_transfer, "STUDIED", ("_colour",))
    monkeypatch.setattr(dagger_transfer, "DETECTORS", known)
    monkeypatch.setattr(dagger_transfer, "load_detector", lambda name: DETECTORS[name])
    register(monkeypatch, DETECTORS)
    monkeypatch.setattr(
        dagger_transfer, "transfer_jobs", lambda names, **_: [job for job in JOBS if len(job.sources) == 1]
    )
    monkeypatch.setattr(dagger_transfer, "read_attack_scene", lambda path: renamed())
    words = ["dagger-transfer", "--seeds", "1", "--judges", "fake_blind", "--out", str(tmp_path), "--json"]
    assert cli.main(words) == 0
    captured = capsys.readouterr()
    assert "other_colour is left out: its file is missing" in captured.err
    assert "fake_blind" not in captured.err
    document = json.loads(captured.out)
    assert document["jobs"] == 2
    assert len(list((tmp_path / "judged").iterdir())) == 4
    assert cli.main(["dagger-transfer", "--detectors", "a", "a", "--out", str(tmp_path)]) == 1
    assert "--detectors: expected different names" in capsys.readouterr().err


def test_splats_of_a_study_over_views_are_judged_on_its_held_out_views(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    quick: dict[str, Any] = {
        "batch": 1,
        "pool": 4,
        "validation": 2,
        "validate_every": 3,
        "held_out": 4,
        "noise_draws": 0,
    }
    config = EotConfig(eps=(2.0,), steps=6, optimiser="momentum", image_psnr=None, **quick)
    made = EotJob(
        group="pairs",
        scene="toy",
        object="car",
        target="person",
        detectors=("fake_colour",),
        config=config,
        transformations=Transformations(cameras=CameraRegion(elevations=(0.0, 10.0))),
    )
    study = tmp_path / "study"
    attacker = EotJobRunner(lambda name: renamed(), DETECTORS.__getitem__, keep=study / "results")
    (record,) = run_jobs([made], study, attacker.run, fingerprint=attacker.fingerprint)
    jobs = held_out_jobs(study, ["fake_colour", "fake_blind"], views=3)
    assert [(job.detector, job.views, job.seed) for job in jobs] == [("fake_colour", 3, 1000), ("fake_blind", 3, 1000)]
    judge = HeldOutRunner(lambda name: renamed(), DETECTORS.__getitem__, study)
    records = run_held_out(jobs, tmp_path / "out", judge)
    assert len(records) == 6
    matrix = {cell.detector: cell for cell in cells(looked_rows(records))}
    assert (matrix["fake_colour"].runs, matrix["fake_colour"].white_box) == (3, True)
    own = [view["target_confidence"] for view in record["result"]["views"][:3]]
    seen = [
        one["judged"]["fake_colour"]["attacked"]["target_score"] for one in records if "fake_colour" in one["judged"]
    ]
    assert seen == pytest.approx(own, abs=1e-4)  # what the study has judged, view by view
    assert matrix["fake_colour"].targeted.successes == sum(score >= 0.5 for score in own) > 0
    assert matrix["fake_colour"].noise_targeted.successes == 0
    assert matrix["fake_blind"].targeted.total == 0

    class Retrained(ColourDetector):
        fingerprint = "another"

    later = HeldOutRunner(lambda name: renamed(), {**DETECTORS, "fake_colour": Retrained()}.__getitem__, study)
    (cell,) = cells(looked_rows(run_held_out(jobs[:1], tmp_path / "later", later)))
    assert (cell.sources, cell.white_box) == (("fake_colour, weights 000000",), False)
    monkeypatch.setattr(dagger_transfer, "load_detector", DETECTORS.__getitem__)
    register(monkeypatch, DETECTORS)
    monkeypatch.setattr(dagger_transfer, "read_attack_scene", lambda path: renamed())
    words = ["dagger-transfer", "--eot-study", str(study), "--detectors", "fake_coarse", "--views", "2"]
    assert cli.main([*words, "--out", str(tmp_path / "judged")]) == 0
    assert "held_out.md" in capsys.readouterr().out
    assert "1 splats" in (tmp_path / "judged" / "held_out.md").read_text()
    document = json.loads((tmp_path / "judged" / "held_out.json").read_text())
    assert (document["study"], document["views"], set(document["weights"])) == (str(study), 2, {"fake_coarse"})
    assert {"versions", "variant", "commit"} <= set(document)
    with pytest.raises(InvalidValueError, match="run mi-splat dagger-eot-study"):
        held_out_jobs(tmp_path, ["fake_colour"], views=2)


class Spec:
    """A detector that can be loaded, or lacks something."""

    def __init__(self, lack: str) -> None:
        self._lack = lack

    def missing(self) -> str:
        return self._lack
