"""Rendering studies on fakes: who looks at what, whose gradient counts, what is not done twice, what is counted."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from attacks import cli
from attacks.cli import rendering_study
from attacks.dagger.jobs import AttackScene
from attacks.dagger.pairs import SEARCHES
from attacks.detectors.base import Detector
from attacks.observe.conditions import SunTable
from attacks.rate import Rate
from attacks.rendering_studies import jobs as study_jobs
from attacks.rendering_studies.config import AttackTable, JudgeTable, Pair, RenderingStudy
from attacks.rendering_studies.figure import draw_rates
from attacks.rendering_studies.gradient_source import with_gradient_of
from attacks.rendering_studies.jobs import StudyAttack, StudyRunner, attacks_of, looks_at
from attacks.rendering_studies.rates import Group, Outcome, outcomes
from attacks.rendering_studies.run import run_study
from attacks.rendering_studies.tables import markdown, write_study
from mi_splat.cameras import Camera
from mi_splat.comparison import methods
from mi_splat.errors import InvalidValueError
from mi_splat.io import load_splat
from mi_splat.rendering import Renderer, RenderSettings
from mi_splat.scene import GaussianScene
from tests.dagger.test_study import toy
from tests.fakes import ColourDetector, blobs, camera, toy_scene

STUDY = RenderingStudy(
    name="toy",
    question="Does it survive?",
    pairs=(Pair(scene="toy", object="car", target="person"),),
    attacks=(AttackTable(eps=(0.01, 12.0), steps=4, renderers=("blobs", "night")),),
    judge=JudgeTable(renderers=("blobs", "night")),
    detectors=("fake_colour",),
    seeds=2,
)
DETECTORS: dict[str, Detector] = {"fake_colour": ColourDetector()}


def night(scene: GaussianScene, camera: Camera) -> Tensor:
    """A renderer in which all is nearly black, so that nothing is found."""
    return 0.05 * blobs(scene, camera)


@pytest.fixture(autouse=True, scope="module")
def _renderers() -> Iterator[None]:
    """Two renderers of a few lines, known by name like the project's own."""
    with pytest.MonkeyPatch.context() as patch:
        for name, render in {"blobs": blobs, "night": night}.items():
            patch.setitem(methods._MAKERS, name, methods._Maker(lambda settings, render=render: render, True))  # type: ignore[misc]
        yield


def place(name: str = "toy") -> AttackScene:
    scene = toy()
    return dataclasses.replace(scene, objects={"car": scene.objects["thing"]})


def runner(out: Path, study: RenderingStudy = STUDY) -> StudyRunner:
    return StudyRunner(study, place, DETECTORS.__getitem__, out)


@pytest.fixture(scope="module")
def done(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[dict[str, Any]]]:
    out = tmp_path_factory.mktemp("study")
    jobs = [job for job in attacks_of(STUDY) if job.renderer == "blobs"]  # in the dark nothing can be attacked
    return out, run_study(STUDY, jobs, out, runner(out))


def test_a_study_is_every_radius_renderer_and_gradient() -> None:
    table = AttackTable(attribute="means", norm="linf", eps=(0.1,), renderers=("a", "b"), gradients=("own", "b"))
    jobs = attacks_of(dataclasses.replace(STUDY, attacks=(*STUDY.attacks, table)))
    assert len({job.name for job in jobs}) == len(jobs)
    first = [(job.renderer, job.gradient, job.config.eps) for job in jobs if job.config.seed == 0]
    assert first == [
        *(("blobs", "own", (0.01,)), ("night", "own", (0.01,)), ("blobs", "own", (12.0,)), ("night", "own", (12.0,))),
        *(("a", "own", (0.1,)), ("a", "b", (0.1,)), ("b", "own", (0.1,))),  # whose own gradient is named twice
    ]
    assert not any(job.config.early_stop for job in jobs)
    assert [job.config.random_start for job in jobs] == [False] * 7 + [True] * 7


def test_who_looks() -> None:
    job = attacks_of(STUDY)[0]
    assert [look.condition for look in looks_at(STUDY, job)] == ["blobs", "night"]
    own = dataclasses.replace(STUDY, judge=JudgeTable(own_renderer=True))
    assert [look.condition for look in looks_at(own, attacks_of(own)[1])] == ["night"]


def test_attacks_are_judged_where_they_were_not_found(done: tuple[Path, list[dict[str, Any]]]) -> None:
    out, records = done
    strong = next(record for record in records if record["job"]["config"]["eps"] == [12.0])
    assert (
        strong["looks"]["blobs"]["attacked"]["target_score"] > 0.5 > strong["looks"]["blobs"]["clean"]["target_score"]
    )
    assert strong["looks"]["blobs"]["noise"]["target_score"] < 0.5
    assert strong["looks"]["night"]["clean"]["original_score"] < 0.5
    assert len(load_splat(next((out / "attacked").iterdir()))) == 30


def test_rates_are_of_the_runs_whose_clean_object_is_found(done: tuple[Path, list[dict[str, Any]]]) -> None:
    found = {(one.group.eps, one.condition): one for one in outcomes(done[1], confidence=0.5)}
    assert (found[12.0, "blobs"].targeted.successes, found[12.0, "blobs"].targeted.total) == (2, 2)
    assert found[12.0, "blobs"].noise_targeted.successes == 0
    assert (found[0.01, "blobs"].targeted.successes, found[0.01, "blobs"].targeted.total) == (0, 2)
    assert (found[12.0, "night"].found.total, found[12.0, "night"].targeted.total) == (2, 0)
    strict = {(one.group.eps, one.condition): one for one in outcomes(done[1], confidence=1.0)}
    assert strict[12.0, "blobs"].targeted.total == 0


def test_the_page_says_what_was_counted(done: tuple[Path, list[dict[str, Any]]], tmp_path: Path) -> None:
    text = markdown(STUDY, done[1])
    assert "| blobs | 0/2 (0.00 to 0.66) | 2/2 (0.34 to 1.00) | 0/4 |" in text
    assert "| night | 0/0 | 0/0 | 0/0 |" in text
    pytest.importorskip("matplotlib", reason="the figure needs the extra figures")
    assert [path.name for path in write_study(STUDY, done[1], tmp_path)] == ["study.md", "study.json", "study.png"]
    document = json.loads((tmp_path / "study.json").read_text())
    assert document["configuration"]["attacks"][0]["eps"] == [0.01, 12.0]
    assert {row["condition"] for row in document["outcomes"]} == {"blobs", "night"}


def test_the_figure_takes_every_rate(tmp_path: Path) -> None:
    """Also those at the ends, whose interval can end on their wrong side by a rounding error."""
    pytest.importorskip("matplotlib", reason="the figure needs the extra figures")
    group = Group(detector="a", renderer="tile", gradient="own", attribute="sh", sh_degree=3, norm="l2", eps=5.0)
    found = []
    for total in range(1, 40):
        none, every = Rate(successes=0, total=total), Rate(successes=total, total=total)
        rates = {"found": every, "targeted": every, "untargeted": none}
        noise = {"noise_targeted": none, "noise_untargeted": none}
        found.append(Outcome(group=group, condition=str(total), target_confidence=0.9, **rates, **noise))
    assert draw_rates("?", found, tmp_path / "a.png")


def test_what_is_done_is_not_done_again(done: tuple[Path, list[dict[str, Any]]]) -> None:
    out, records = done

    class Idle(StudyRunner):
        def attack(self, job: StudyAttack) -> dict[str, Any]:
            raise AssertionError(job.name)

    jobs = [job for job in attacks_of(STUDY) if job.renderer == "blobs"]
    again = run_study(STUDY, jobs, out, Idle(STUDY, place, DETECTORS.__getitem__, out))
    assert again == json.loads(json.dumps(records))


def test_pictures_are_of_one_renderer_and_gradients_of_another() -> None:
    scene, _ = toy_scene()
    both = with_gradient_of(night, blobs)
    weights = torch.rand(camera().height, camera().width, 3)

    def gradient(render: Any) -> Tensor:
        sh = scene.sh.clone().requires_grad_(True)
        (render(scene.replace(sh=sh), camera()) * weights).sum().backward()
        assert sh.grad is not None
        return sh.grad

    assert torch.equal(both(scene, camera()), blobs(scene, camera()))
    learned = both(scene.replace(sh=scene.sh.clone().requires_grad_(True)), camera())
    torch.testing.assert_close(learned.detach(), blobs(scene, camera()))
    torch.testing.assert_close(gradient(both), gradient(night))
    assert not torch.allclose(gradient(both), gradient(blobs))


def test_the_command_writes_the_tables(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any) -> None:
    monkeypatch.setattr(rendering_study, "load_detector", DETECTORS.__getitem__)
    monkeypatch.setattr(rendering_study, "read_attack_scene", place)
    file = tmp_path / "s.toml"
    file.write_text(
        'name = "s"\nquestion = "Q?"\ndetectors = ["fake_colour"]\n'
        '[[pairs]]\nscene = "toy"\nobject = "car"\ntarget = "person"\n'
        '[[attacks]]\neps = [12.0]\nsteps = 2\nrenderers = ["blobs"]\n[judge]\nown_renderer = true\n'
    )
    words = ["rendering-study", str(file), "--out", str(tmp_path / "out"), "--seeds", "1", "--json"]
    assert cli.main(words) == 0
    said = json.loads(capsys.readouterr().out)
    assert said["attacks"] == 1
    assert (tmp_path / "out" / "study.md").read_text().startswith("# Q?")


def test_a_strong_search_has_its_own_objective(tmp_path: Path) -> None:
    table = dataclasses.replace(STUDY.attacks[0], search="strong", eps=(12.0,), renderers=("blobs",))
    study = dataclasses.replace(STUDY, attacks=(table,), confidence=0.3)
    (job, _) = attacks_of(study)
    found = runner(tmp_path, study).attack(job)
    assert found["config"]["schedule"] == "cosine"
    settings = {"confidence": 0.3, **SEARCHES["strong"].objective}
    assert settings.items() <= found["config"]["objective"].items()


@pytest.mark.parametrize(("camera", "match"), [(2, "0 to 1"), (0, None)])
def test_a_camera_that_is_not_there(camera: int, match: str | None, tmp_path: Path) -> None:
    pair = Pair(scene="toy", object="car", target="person", camera=camera)
    job = attacks_of(dataclasses.replace(STUDY, pairs=(pair,)))[0]
    if match is None:
        assert runner(tmp_path).attack(job)["objective"]
        return
    with pytest.raises(InvalidValueError, match=match):
        runner(tmp_path).attack(job)


def test_fingerprints_follow_all_that_a_job_does_not_say(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    job = attacks_of(STUDY)[0]
    look = looks_at(STUDY, job)[0]
    (tmp_path / "street.xml").write_text('<scene version="3.0.0"><string name="filename" value="car.ply"/></scene>')
    (tmp_path / "car.ply").write_text("ply")
    sun = SunTable(scene=str(tmp_path / "street.xml"), hours=(12.0,))
    sunny = dataclasses.replace(STUDY, judge=JudgeTable(sun=sun))
    marks = {runner(tmp_path).fingerprint(job), runner(tmp_path).fingerprint(attacks_of(STUDY)[-1])}
    assert len(marks) == 1
    marks.add(runner(tmp_path, dataclasses.replace(STUDY, confidence=0.3)).fingerprint(job))
    other = dataclasses.replace(place(), render=Renderer(RenderSettings(background=(0.0, 0.0, 1.0))))
    marks.add(StudyRunner(STUDY, lambda name: other, DETECTORS.__getitem__, tmp_path).fingerprint(job))
    other = dataclasses.replace(place(), objects={"car": slice(10, 39)})
    marks.add(StudyRunner(STUDY, lambda name: other, DETECTORS.__getitem__, tmp_path).fingerprint(job))
    with monkeypatch.context() as patch:
        search = dataclasses.replace(SEARCHES["paper"], objective={"near": 0.9})
        patch.setattr(study_jobs, "SEARCHES", {**SEARCHES, "paper": search})
        marks.add(runner(tmp_path).fingerprint(job))
    assert len(marks) == 5
    looks = {runner(tmp_path, study).look_fingerprint(look) for study in (STUDY, sunny)}
    looks.add(runner(tmp_path, dataclasses.replace(sunny, confidence=0.3)).look_fingerprint(look))
    for name in ("car.ply", "street.xml"):
        (tmp_path / name).write_text((tmp_path / name).read_text() + "\n")
        looks.add(runner(tmp_path, sunny).look_fingerprint(look))
    assert len(looks) == 5


def test_another_confidence_is_another_attack(tmp_path: Path) -> None:
    jobs = attacks_of(STUDY)[:1]
    first, again, other = (
        run_study(study, jobs, tmp_path, runner(tmp_path, study))[0]["attack"]
        for study in (STUDY, STUDY, dataclasses.replace(STUDY, confidence=0.3))
    )
    assert first["seconds"] == again["seconds"] != other["seconds"]
    assert (first["config"]["objective"]["confidence"], other["config"]["objective"]["confidence"]) == (0.5, 0.3)
