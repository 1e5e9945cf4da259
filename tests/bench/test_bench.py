"""`mi-splat bench` with a tiny suite and toy detectors: what a row says, and what makes
it be refused.
"""

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from attacks import cli
from attacks.bench.row import robust, warnings
from attacks.bench.suite import BenchWork, read_suite
from attacks.cli.bench import BenchOptions, usual_folder
from attacks.detectors.catalogue import SMALL_WEIGHTS
from attacks.detectors.registry import CHOSEN_WEIGHTS
from attacks.figures.frame import MEASURE, Figures, read_figures
from attacks.figures.rate import Rate
from attacks.figures.result import read_result
from attacks.observe.rows import read_rows
from attacks.report.checking import check_result
from attacks.report.results import kind_of
from mi_splat.ledger import engines
from tests.project.layers import ROOT
from tests.studies.toy import toys, write_toy

__all__ = ["toys"]
pytestmark = [pytest.mark.usefixtures("toys"), pytest.mark.shipped]
FILES = {
    "suite": (
        'question = "Does it still see it?"\nsurrogates = ["fake_colour",'
        ' "fake_coarse"]\n'
    ),
    "one_view": (
        """
study = "dagger"
scene = "{scene}"
object = "car"
aim = "untargeted"
attack = {{ steps = 4, noise_draws = 0 }}
[matrix]
seed = [0, 1, 2]
camera = [0, 1]
budget = [
  {{ name = "weak", attack = {{ eps = 0.001 }} }},
  {{ name = "strong", attack = {{ eps = 12.0 }} }},
]
"""
    ),
    "transfer": (
        """
base = "one_view.toml"
attack = {{ early_stop = false }}
[matrix]
budget = [{{ name = "strong", attack = {{ eps = 12.0 }} }}]
"""
    ),
    "all_views": (
        """
study = "dagger-eot"
scene = "{scene}"
object = "car"
aim = "untargeted"
cameras.azimuths = [-120.0, -60.0]
cameras.elevations = [0.0, 10.0]
cameras.distances = [0.9, 1.1]
seed = 5
[attack]
eps = 2.0
steps = 4
batch = 1
pool = 4
validation = 2
validate_every = 2
held_out = 12
held_out_seed = 77
optimiser = "momentum"
image_psnr = "none"
"""
    ),
}


@pytest.fixture(scope="module")
def suite(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a suite without CLOAK."""
    folder = tmp_path_factory.mktemp("suites") / "tiny"
    folder.mkdir()
    scene = write_toy(folder / "scene")
    for name, text in FILES.items():
        (folder / f"{name}.toml").write_text(text.format(scene=scene))
    return folder


def bench(suite: Path, out: str, *words: str) -> int:
    folder = suite.parent
    line = [
        "bench",
        "fake_colour",
        "--suite",
        str(suite),
        "--store",
        str(folder / "store"),
        "--workers",
        "0",
    ]
    return cli.main([*line, "--out", str(folder / out), *words])


def read(path: Path) -> dict[str, Any]:
    record: dict[str, Any] = json.loads(path.read_text())
    return record


@pytest.fixture(scope="module")
def out(suite: Path, toys: None) -> Path:
    """The folder of a row."""
    assert bench(suite, "row") == 0
    return suite.parent / "row"


def test_a_row_counts_what_is_still_named(out: Path) -> None:
    figures = read_figures(out)
    one = figures.where(part="one_view")
    for setting in one.labels("setting"):
        expected = 3 if "weak" in setting else 0
        assert one.rate("robust", setting=setting).successes == expected
    rate = one.rate("robust")
    assert rate.counts == "6 of 12"
    assert rate.interval[0] < 0.5 < rate.interval[1]
    assert one.rate("named_clean").fraction == 1.0
    several = figures.rate("robust", part="all_views")
    assert several.total == 12
    assert several.fraction < 0.5
    assert figures.rate("robust", part="transfer").total == 6
    assert robust(figures, "transfer") is None
    assert robust(figures, "cloak") is None
    assert figures.find("score") is None
    text = (out / "table.md").read_text()
    assert "| - | fake_colour | - |" in text
    assert "not evaluated (6 views)" in text
    assert set(read(out / "result.json")["cpu_seconds"]) == {
        "one_view",
        "all_views",
        "transfer",
        "shared",
        "all",
    }


def test_attacks_that_were_too_weak_are_told(out: Path) -> None:
    figures = read_figures(out)
    assert list(warnings(figures)) == []
    weak = Rate(successes=40, total=40, resampled=(0.9, 1.0))
    strong = Rate(successes=20, total=40, resampled=(0.35, 0.65))
    changed = Figures.of(
        [
            ({MEASURE: "robust", "part": "one_view"}, weak),
            ({MEASURE: "noise", "part": "one_view"}, weak),
            ({MEASURE: "robust", "part": "transfer"}, strong),
        ]
    )
    hidden, noise = warnings(Figures.together([figures, changed]))
    assert "gradients may be hidden" in hidden
    assert "one view" in noise


def test_surrogates_are_others(out: Path) -> None:
    rows = read_rows(out / "rows.csv.xz")
    assert set(rows["detector"]) == {"fake_colour"}
    record = read(out / "result.json")
    assert len(record["attacks"]) == 12 + 1 + 6
    looks = rows.filter(rows["attack"].str.starts_with("transfer"))
    assert len(looks) == 6 * 3
    made = {
        row["original_score"]
        for row in looks.iter_rows(named=True)
        if row["splat"] == "attacked"
    }
    assert made != {
        row["original_score"]
        for row in rows.iter_rows(named=True)
        if row["splat"] == "clean"
    }


def test_a_column_without_its_surrogates_is_not_filled(suite: Path) -> None:
    asked = replace(read_suite(str(suite)), surrogates=("fake_colour", "nobody"))
    work = BenchWork(asked, "fake_colour")
    assert {entry.column for entry in work.attempts} == {"one_view", "all_views"}
    assert "nobody" in work.missing["transfer"]
    assert work.missing["cloak"] == "not in the suite"
    assert (
        BenchWork(asked, "fake_colour", columns=["one_view"]).missing["all_views"]
        == "not done"
    )


def test_weights_of_a_file_are_asked(
    suite: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "mine.safetensors"
    file.write_bytes(SMALL_WEIGHTS.read_bytes())
    monkeypatch.setenv(CHOSEN_WEIGHTS, "{}")
    work = BenchWork(
        read_suite(str(suite)), "fasterrcnn_small", weights=file, columns=["one_view"]
    )
    first = work.attempts[0]
    assert file in first.made[first.title].inputs.values()
    assert work.detector.name == "fasterrcnn_small"
    code = (
        "from attacks.detectors.registry import detector_spec;"
        " print(detector_spec('fasterrcnn_small').weights())"
    )
    worker = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        check=True,
        cwd=ROOT,
    )
    assert worker.stdout.strip() == str(file), "processes that do jobs know the file"


def test_a_row_is_counted_again_without_attacks(
    out: Path,
    suite: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(engines, "run_job", None)
    assert cli.main(["artifact-check", str(out)]) == 0
    assert "6/12" in capsys.readouterr().out


def test_a_defence_is_judged_on_the_same_views(suite: Path, out: Path) -> None:
    assert (
        bench(suite, "defended", "--defence", "SH of degree 0", "--columns", "one_view")
        == 0
    )
    one = read_figures(suite.parent / "defended").where(part="one_view")
    assert one.rate("robust") == read_figures(out).rate("robust", part="one_view")
    defended = one.where(scope="defended")
    assert {rate.total for _, rate in defended} == {12}
    assert {*defended.labels(MEASURE)} == {"robust", "clean", "robust_if_known"}
    assert defended.rate("clean").fraction == 1.0
    adaptive = defended.rate("robust_if_known").fraction
    assert adaptive <= defended.rate("robust").fraction


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (("fake_colour", "--suite", "v11"), "suite: expected v1"),
        (("fake_colour", "--defence", "SH of degree 9"), "SH of degree"),
    ],
)
def test_what_is_not_there_is_said(
    words: tuple[str, ...], text: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["bench", *words]) == cli.FAILED
    assert text in capsys.readouterr().err


def test_the_rows_of_the_repository_are_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(ROOT)
    folders = list(Path("docs/bench/v1").glob("*"))
    assert folders
    for folder in folders:
        result = read_result(folder)
        checks = check_result(result, kind_of(result).derive)
        assert [check.name for check in checks if check.passed is False] == []
        suite = result.record["suite"]
        assert (suite["name"], suite["digest"]) == ("v1", read_suite("v1").digest)


def test_rows_of_other_weights_and_defences_have_folders_of_their_own() -> None:
    asked: list[dict[str, Any]] = [
        {},
        {"weights": Path("a/mine.pth")},
        {"defence": "JPEG 60"},
    ]
    folders = [usual_folder(BenchOptions(detector="fake", **more)) for more in asked]
    names = ["v1/fake", "v1/fake_mine", "v1/fake_JPEG_60"]
    assert folders == [Path("out/bench") / name for name in names]
