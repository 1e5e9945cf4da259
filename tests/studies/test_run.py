"""`mi-splat study` on a toy scene: what it writes, what its tables count, and what it
does with what it keeps.
"""

import json
from pathlib import Path
from typing import Any

import pytest

from attacks import cli, rows, run_study
from attacks.figures.frame import AXIS, MEASURE, read_figures
from attacks.figures.rate import Rate
from attacks.figures.result import read_result
from attacks.observe.rows import ATTACKED
from attacks.report.checking import check_figures
from attacks.report.results import kind_of
from attacks.studies import attack as attack_kind
from attacks.studies import running as running_study
from attacks.studies.result import BLACK_BOX, EVALUATION, SEARCH, SETTING, WHITE_BOX
from mi_splat.errors import InvalidValueError
from mi_splat.io import load_splat
from mi_splat.ledger import Store
from tests.studies.toy import write_toy

pytestmark = pytest.mark.usefixtures("toys")
STUDY = """
study = "dagger"
question = "Does it hold?"
scene = "{scene}"
object = "car"
detectors = ["fake_colour"]
attack = {{ steps = 4, noise_draws = 1 }}
[matrix]
seed = [0, 1]
"attack.eps" = [0.01, 12.0]
[[case]]
name = "seen as a person"
target = "person"
[[case]]
name = "hidden"
aim = "hide"
[evaluate_with.matrix]
condition = [".ply", "SH of degree 0"]
detector = ["fake_colour", "fake_coarse"]
"""
EOT = """
study = "dagger-eot"
scene = "{scene}"
object = "car"
target = "person"
detectors = ["fake_colour"]
cameras.azimuths = [-120.0, -60.0]
cameras.elevations = [0.0, 10.0]
cameras.distances = [0.9, 1.1]
[attack]
steps = 4
batch = 1
pool = 4
validation = 2
validate_every = 2
held_out = 4
optimiser = "momentum"
image_psnr = "none"
[bisect]
field = "attack.eps"
values = [0.001, 0.01, 2.0]
[evaluate_with]
views = 3
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the toy scene, two studies, and a store."""
    folder = tmp_path_factory.mktemp("run")
    scene = write_toy(folder)
    (folder / "toy.toml").write_text(STUDY.format(scene=scene))
    (folder / "eot.toml").write_text(EOT.format(scene=scene))
    return folder


def study(folder: Path, action: str, name: str = "toy", *words: str) -> int:
    line = [
        "study",
        action,
        str(folder / f"{name}.toml"),
        "--store",
        str(folder / "store"),
        "--workers",
        "0",
    ]
    return cli.main([*line, "--out", str(folder / name), *words])


@pytest.fixture(scope="module")
def run(folder: Path, toys: None) -> dict[str, Any]:
    """result.json of the first study."""
    assert study(folder, "run") == 0
    record: dict[str, Any] = json.loads((folder / "toy" / "result.json").read_text())
    return record


def test_the_result_says_what_was_done(folder: Path, run: dict[str, Any]) -> None:
    names = {
        "figures.csv",
        "manifest.json",
        "result.json",
        "rows.csv.xz",
        "study.toml",
        "table.md",
    }
    assert {
        path.name
        for path in (folder / "toy").iterdir()
        if not path.name.startswith(".")
    } == names
    assert (folder / "toy" / "study.toml").read_text() == (
        folder / "toy.toml"
    ).read_text()
    assert (run["story"], run["study"], run["question"]) == (
        "study",
        "dagger",
        "Does it hold?",
    )
    assert len(run["attacks"]) == 8
    figures = read_figures(folder / "toy")
    strong = {
        name: one
        for name, one in run["attacks"].items()
        if one["labels"]["attack.eps"] == 12.0
    }
    for name in strong:
        assert figures.rate("reached", attack=name, splat=ATTACKED).successes == 1
    assert {one["part"] for one in strong.values()} == {"seen as a person", "hidden"}
    for one in run["attacks"].values():
        assert (
            len(
                load_splat(
                    Store(folder / "store").folder_of(one["key"])
                    / "files"
                    / "object.ply"
                )
            )
            == 30
        )


def test_every_figure_follows_from_the_rows(folder: Path, run: dict[str, Any]) -> None:
    result = read_result(folder / "toy")
    checks = check_figures(result, kind_of(result).derive)
    assert {check.passed for check in checks} == {True}
    name, attack = next(iter(run["attacks"].items()))
    files = Store(folder / "store").folder_of(attack["key"]) / "files"
    stated = json.loads((files / "result.json").read_text())
    reached = result.figures.rate("reached", attack=name, splat=ATTACKED)
    assert bool(reached.successes) == stated["success"]


def test_looks_count_runs_whose_clean_object_is_found(
    folder: Path, run: dict[str, Any]
) -> None:
    figures = read_figures(folder / "toy").where(scope=EVALUATION)
    strong = figures.where(condition=".ply", **{f"{AXIS}attack.eps": "12"})
    person = strong.where(part="seen as a person")
    own = person.where(detector="fake_colour", access=WHITE_BOX)
    assert own.rate("targeted") == Rate(successes=2, total=2)
    assert own.rate("noise_targeted").successes == 0
    assert len(person.where(detector="fake_coarse", access=BLACK_BOX))
    hidden = strong.where(part="hidden", detector="fake_colour", access=WHITE_BOX)
    # its objective is that nothing at all is reported
    assert not {"targeted", "untargeted"} & set(hidden.labels(MEASURE))
    assert hidden.rate("reached").successes == 2


def test_nothing_is_done_twice_and_nothing_lost(
    folder: Path,
    run: dict[str, Any],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(attack_kind, "run", None)
    assert study(folder, "run") == 0
    again = json.loads((folder / "toy" / "result.json").read_text())
    assert {**again, "command": None} == {**run, "command": None}
    capsys.readouterr()
    assert study(folder, "plan", "toy", "--json") == 0
    planned = json.loads(capsys.readouterr().out)
    assert planned["jobs"] == planned["done"] == 8 + 8 * 4
    assert study(folder, "status", "toy", "--json") == 0
    assert json.loads(capsys.readouterr().out) == {
        **{
            "waiting": 0,
            "ready": 0,
            "running": 0,
            "done": 40,
            "failed": 0,
            "failures": {},
        }
    }


def test_a_script_runs_a_study_as_the_command_does(
    folder: Path, run: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(attack_kind, "run", None)  # all of it is in the store
    out = run_study(folder / "toy.toml", store=folder / "store", out=folder / "script")
    assert out == folder / "script"
    assert rows(out).equals(rows(folder / "toy"))
    again = json.loads((out / "result.json").read_text())
    assert {**again, "command": None} == {**run, "command": None}
    with pytest.raises(TypeError):  # of a job that is done in this process, as it is
        run_study(
            folder / "toy.toml",
            store=folder / "other",
            out=folder / "failed",
            parts=["hidden"],
        )
    failed = running_study.Run(jobs=2, failed={"hidden": "no memory\n"}, files=())
    monkeypatch.setattr(running_study, "run_with", lambda *_, **__: failed)
    with pytest.raises(
        InvalidValueError,
        match=(
            "expected 2 jobs that are done, got 1 that failed; hidden: no memory; mend"
        ),
    ):
        run_study(folder / "toy.toml", store=folder / "store", out=folder / "failed")


def test_a_plan_forecasts_from_measured_seconds(
    folder: Path, run: dict[str, Any], capsys: pytest.CaptureFixture[str]
) -> None:
    text = (
        (folder / "toy.toml").read_text().replace("seed = [0, 1]", "seed = [0, 1, 2]")
    )
    (folder / "longer.toml").write_text(text)
    capsys.readouterr()
    assert study(folder, "plan", "longer", "--json") == 0
    planned = json.loads(capsys.readouterr().out)
    assert (planned["jobs"], planned["done"], planned["not_measured"]) == (60, 40, 0)
    assert planned["seconds"] > 0
    assert study(folder, "plan", "longer", "--parts", "hidden") == 0
    assert "30 jobs, 20 of them done." in capsys.readouterr().out


def test_a_search_over_views_of_a_region(folder: Path, toys: None) -> None:
    assert study(folder, "run", "eot") == 0
    record = json.loads((folder / "eot" / "result.json").read_text())
    figures = read_figures(folder / "eot")
    search = figures.where(scope=SEARCH, setting="attack.eps")
    assert search.value("smallest") == 2.0
    assert search.value("not_enough") == 0.01
    assert len(record["attacks"]) == 2  # 0.001 was never looked at
    strong = {f"{AXIS}attack.eps": "2"}
    reached = figures.where(scope=SETTING, **strong)
    assert reached.rate("success", splat=ATTACKED) == Rate(successes=4, total=4)
    for rate in figures.where(scope=EVALUATION, **strong).rates("untargeted"):
        assert rate.total <= 3
    page = (folder / "eot" / "table.md").read_text()
    assert "## The smallest that suffices" in page
    assert "| 2 | 0.01 |" in page
    result = read_result(folder / "eot")
    checks = check_figures(result, kind_of(result).derive)
    assert {check.passed for check in checks} == {True}


def test_failed_jobs_are_named_and_tried_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    scene = write_toy(tmp_path)
    (tmp_path / "toy.toml").write_text(
        STUDY.format(scene=scene).replace("[0.01, 12.0]", "[12.0]")
    )
    words = ("--parts", "hidden", "--json")
    store = Store(tmp_path / "store")
    assert study(tmp_path, "plan", "toy", *words) == 0

    def fails(*_: Any) -> None:
        raise ValueError("poisoned")

    with monkeypatch.context() as patch:
        patch.setattr(attack_kind, "run", fails)
        with pytest.raises(ValueError, match="poisoned"):
            study(tmp_path, "run", "toy", *words)
    capsys.readouterr()
    with monkeypatch.context() as patch:
        patch.setattr("mi_splat.ledger.store.TRIES", 1)
        assert study(tmp_path, "status", "toy", "--json") == 0
    assert "poisoned" in next(
        iter(json.loads(capsys.readouterr().out)["failures"].values())
    )
    assert study(tmp_path, "run", "toy", *words) == 0
    assert len(store.keys()) == 2 + 8
    assert study(tmp_path, "clean", "toy") == 0
    assert store.keys() == set()
    assert (tmp_path / "toy" / "result.json").is_file()
