"""Every kind of result becomes a section: its figures are those of its files, its command is one that repeats it."""

from __future__ import annotations

import dataclasses
import json
import shlex
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from attacks.cli import COMMANDS
from attacks.cli.parsing import parse
from attacks.cloak.study.study_file import read_study
from attacks.dagger.config import DaggerConfig
from attacks.dagger.eot.config import EotConfig
from attacks.dagger.eot.report import write_eot_report
from attacks.dagger.eot.tables import write_eot_tables
from attacks.dagger.pairs import run_pairs, write_summary
from attacks.dagger.sanity.finding import Finding
from attacks.dagger.sanity.runs import Runs
from attacks.dagger.sanity.suite import write_findings
from attacks.dagger.study import run_jobs
from attacks.dagger.tables import write_tables
from attacks.dagger.transfer import tables as transfer_tables
from attacks.dagger.transfer.study import run_transfer
from attacks.rate import Rate
from attacks.reporting.results import KINDS, read_section
from attacks.reporting.section import Section
from mi_splat import provenance
from mi_splat.errors import InvalidValueError
from mi_splat.io.camera_records import describe
from mi_splat.io.documents import save_json
from tests.dagger import test_pairs, test_sanity, test_study, test_transfer
from tests.dagger.eot import test_study as eot_study
from tests.dagger.eot.toy import quick
from tests.fakes import camera
from tests.reporting.results import STUDIED, change, rate, write_cloak, write_dagger, write_evaluation, write_variations


def options(section: Section, place: int = 0) -> Any:
    """What the command line makes of the command that repeats a result."""
    program, name, *words = shlex.split(section.command[place])
    assert program == "mi-splat"
    return parse(name, COMMANDS[name], words)


def complaint(folder: Path) -> str | None:
    """What is wrong with a folder; other errors than those that are meant for people pass."""
    try:
        read_section(folder)
    except InvalidValueError as error:
        return str(error)
    return None


def write_eot(folder: Path) -> Path:
    write_eot_report(quick(), folder)
    change(folder / "result.json", scene="toy.xml", selection={"object": "thing"}, cameras=["front"])
    return folder


def write_study(folder: Path) -> Path:
    one = test_study.runner()
    write_tables(run_jobs(test_study.JOBS, folder, one.run, fingerprint=one.fingerprint), folder)
    return folder


def write_eot_study(folder: Path) -> Path:
    one, setup = eot_study.runner(), eot_study.SETUP
    jobs = [setup.job("smallest", eps=(radius,)) for radius in (0.01, 2.0)]
    jobs += [setup.job("curve", eps=(radius,)) for radius in (0.05, 2.0)]
    write_eot_tables(run_jobs(jobs, folder, one.run, fingerprint=one.fingerprint), folder)
    return folder


def write_pairs(folder: Path) -> Path:
    folder.mkdir()
    found = run_pairs({"a": test_pairs.summary_of, "b": test_pairs.summary_of}, eps=(2.0, 5.0), steps=40, seeds=(0, 1))
    write_summary(found, folder)
    return folder


def write_transfer(folder: Path) -> Path:
    judges = list(test_transfer.DETECTORS)
    records = run_transfer(test_transfer.JOBS[:3], judges, folder, test_transfer.runner(folder))
    transfer_tables.write_tables(records, folder)
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


MAKERS: dict[str, Callable[[Path], Path]] = {
    "dagger": write_dagger,
    "dagger-eot": write_eot,
    "dagger-pairs": write_pairs,
    "cloak": write_cloak,
    "cloak --vary": write_variations,
    "dagger-study": write_study,
    "dagger-eot-study": write_eot_study,
    "dagger-transfer": write_transfer,
    "dagger-transfer --eot-study": write_held_out,
    "dagger-sanity": write_sanity,
    "evaluate": write_evaluation,
}


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    base = tmp_path_factory.mktemp("results")
    return {name: make(base / name.replace(" ", "")) for name, make in MAKERS.items()}


def test_every_kind_is_tried() -> None:
    assert [kind.command for kind in KINDS] == list(MAKERS)


@pytest.mark.parametrize("name", MAKERS)
def test_every_kind_is_read_and_its_command_is_understood(name: str, folders: dict[str, Path]) -> None:
    section = read_section(folders[name])
    assert section.folder == str(folders[name])
    assert section.command
    for place in range(len(section.command)):
        assert str(options(section, place).out) == f"{folders[name]}-again"
        assert set(name.split()) <= set(shlex.split(section.command[place]))
    for text in (section.done, section.conclusion, *section.warnings):
        assert text.endswith(".")
        assert "None" not in text
    assert section.configuration
    assert section.versions
    for table in section.tables:
        assert table.rows
        assert {len(row) for row in table.rows} == {len(table.head)}
    for chart in section.charts:
        assert any(line.points for line in chart.lines)
    if name != "dagger-sanity":
        assert section.control is not None


@pytest.mark.parametrize("name", MAKERS)
def test_what_is_broken_is_told_in_one_line(name: str, folders: dict[str, Path], tmp_path: Path) -> None:
    (kind,) = (one for one in KINDS if one.command == name)
    whole = json.loads((folders[name] / kind.record).read_text())
    (tmp_path / kind.record).write_text("{")
    with pytest.raises(InvalidValueError, match="expected a JSON object"):
        read_section(tmp_path)
    wrong: tuple[Any, ...] = (None, 3, "text", {"x": []})
    for key in list(whole):
        for value in wrong:
            (tmp_path / kind.record).write_text(json.dumps({**whole, key: value}))
            said = complaint(tmp_path)
            assert said is None or ": expected " in said
    (tmp_path / kind.record).write_text("{}")
    with pytest.raises(InvalidValueError, match=r"expected .* again"):
        read_section(tmp_path)


@pytest.mark.parametrize(
    ("path", "words"),
    [("nothing", "nothing there"), ("empty", "one without a result"), ("file.json", "a file; pass ")],
)
def test_what_is_no_result_is_told(path: str, words: str, tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "file.json").write_text("{}")
    with pytest.raises(InvalidValueError, match=words):
        read_section(tmp_path / path)


def test_an_attack_s_figures_and_settings(folders: dict[str, Path]) -> None:
    section, folder = read_section(folders["dagger"]), folders["dagger"]
    assert section.title == "thing to person"
    assert section.headline.rate == Rate(successes=1, total=1)
    assert section.control is not None
    assert section.control.rate == Rate(successes=0, total=5)
    assert section.warnings[-1].startswith("Few views: 1")
    assert [picture.path.name for picture in section.pictures] == ["detections.png", "difference.png"]
    given = options(section)
    assert given.config == DaggerConfig(eps=(12.0,))
    assert given.view.cameras == (str(folder / "result.json"),)
    assert (given.selection.object, given.target) == ("thing", "person")
    assert dict(section.configuration)["eps"] == "12"


def test_an_attack_without_a_control_says_so(tmp_path: Path) -> None:
    section = read_section(write_dagger(tmp_path / "a", noise_draws=0))
    assert section.control is None
    assert any("no control" in text for text in section.warnings)


def test_settings_of_a_command_are_those_of_the_result(tmp_path: Path) -> None:
    config = DaggerConfig(
        attributes=("sh", "means"), eps=(1.5, 0.01), norm="linf", sh_degree=None, early_stop=False, random_start=True
    )
    folder = write_dagger(tmp_path / "a")
    stored = json.loads((folder / "result.json").read_text())
    changed = {**stored["config"], **json.loads(json.dumps(dataclasses.asdict(config)))}
    change(folder / "result.json", config={**changed, "objective": {"confidence": 0.5}}, objective="hide", target=None)
    given = options(read_section(folder))
    assert given.config == config
    assert (given.objective, given.confidence) == ("hide", 0.5)


def test_an_attack_made_from_python_has_no_command(tmp_path: Path) -> None:
    folder = write_dagger(tmp_path / "a")
    stored = json.loads((folder / "result.json").read_text())
    (folder / "result.json").write_text(json.dumps({k: v for k, v in stored.items() if k != "scene"}))
    section = read_section(folder)
    assert section.command == ()
    assert "Python" in section.repeating


def test_an_attack_on_a_region(folders: dict[str, Path]) -> None:
    section = read_section(folders["dagger-eot"])
    stored = json.loads((folders["dagger-eot"] / "result.json").read_text())
    assert section.headline.rate == Rate(successes=stored["rate"]["successes"], total=8)
    given = options(section)
    wanted = {field.name: stored["config"][field.name] for field in dataclasses.fields(EotConfig)}
    assert json.loads(json.dumps(dataclasses.asdict(given.config))) == wanted
    assert (given.region.azimuths, given.region.elevations) == ((-120.0, -60.0), (0.0, 30.0))


def test_a_study_s_file_is_the_study(folders: dict[str, Path], tmp_path: Path) -> None:
    for name in ("cloak", "cloak --vary"):
        section = read_section(folders[name])
        assert section.file is not None
        (tmp_path / section.file[0]).write_text(section.file[1])
        assert read_study(tmp_path / section.file[0]) == STUDIED


def test_a_study_says_what_speaks_against_it(folders: dict[str, Path], tmp_path: Path) -> None:
    section = read_section(folders["cloak"])
    assert section.headline.rate == Rate(successes=36, total=40)
    assert section.control is not None
    assert section.control.rate == Rate(successes=1, total=40)
    said = " ".join(section.warnings)
    assert "Not stealthy" in said
    assert "The attack rear fails" in said
    assert "look at each seed" in said
    one = write_cloak(tmp_path / "one", seeds=[0], control_recall=rate(4, 40))
    said = " ".join(read_section(one).warnings)
    assert "One seed" in said
    assert "found in 4 of 40 views only" in said


def test_a_study_that_hides_nothing_has_the_target_class_as_its_figure(tmp_path: Path) -> None:
    folder = write_cloak(tmp_path / "a", trigger_miss_rate=None, control_recall=None, target_rate=rate(20, 40))
    section = read_section(folder)
    assert section.headline.rate == Rate(successes=20, total=40)
    assert section.control is not None
    assert section.control.rate == Rate(successes=0, total=40)


def test_red_lines_of_sanity_are_warnings(folders: dict[str, Path]) -> None:
    section = read_section(folders["dagger-sanity"])
    assert section.headline.value == "1 of 2"
    assert len(section.warnings) == 2


def test_transfer_counts_detectors_that_were_not_attacked(folders: dict[str, Path]) -> None:
    section = read_section(folders["dagger-transfer --eot-study"])
    assert section.headline.rate == Rate(successes=8, total=40)
    given = options(section)
    assert (given.eot_study, given.views, given.scenes) == (Path("out/study"), 12, Path("elsewhere"))
    assert section.repeating == ""
    assert not any("hides the object" in text for text in section.warnings)
    assert any(
        "fake_blind finds the clean object in 0 of" in text
        for text in read_section(folders["dagger-transfer"]).warnings
    )


def test_where_settings_vary_attacks_are_counted(folders: dict[str, Path]) -> None:
    section = read_section(folders["dagger-eot-study"])
    assert section.headline.label.startswith("attacks that hold")
    assert options(section).groups == ("curve", "smallest")
    assert any(chart.title.startswith("Success over the radius") for chart in section.charts)
