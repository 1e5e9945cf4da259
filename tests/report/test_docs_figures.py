"""The figures of the documentation are what the raw rows of docs/artifacts give."""

import re
import runpy
from collections import Counter
from collections.abc import Mapping, Sequence
from functools import cache
from typing import Any

import polars as pl
import pytest

from attacks.objectives import LEFT, REPORTED
from attacks.observe.rows import ATTACKED, CLEAN, ROWS
from attacks.report.checking import Result, check_result, flat, in_words, read_result
from attacks.report.results import kind_of
from tests.project.documented_commands import ROOT

ARTIFACTS = ROOT / "docs" / "artifacts"
OUR = ("fasterrcnn_small", "yolov8n_small")
PAGES: Mapping[str, Any] = runpy.run_path(str(ROOT / "docs" / "sphinx_extensions" / "result_tables.py"))["PAGES"]
FRACTION = re.compile(r"(?<![\w/.])(\d+/\d+)(?![\w/]|\.\d)")
MOST_BYTES = 12_000_000
"""Of all artifacts."""


@cache
def result_of(name: str) -> Result:
    return read_result(ARTIFACTS / name)


def test_every_artifact_is_green_and_known_by_its_manifest() -> None:
    """The figures of all, counted: none is lost."""
    page = (ROOT / "docs" / "artifacts.md").read_text()
    figures = rates = 0
    for folder in sorted(ARTIFACTS.iterdir()):
        result = result_of(folder.name)
        assert f"`docs/artifacts/{folder.name}`" in page
        assert result.manifest.sha256 in page
        derive = kind_of(result).figures
        assert derive is not None
        document = derive(result.record, result.tables)  # takes seconds
        lines = check_result(result, lambda *_, document=document: document)
        assert [(line.name, line.words) for line in lines if line.passed is False] == []
        derived = flat(document)
        figures += len(derived)
        rates += sum(isinstance(value, tuple) for value in derived.values())
    assert (figures, rates) == (55927, 21677)


def test_artifacts_are_small_and_name_no_machine() -> None:
    files = [path for path in ARTIFACTS.rglob("*") if path.is_file()]
    assert sum(path.stat().st_size for path in files) <= MOST_BYTES
    for path in files:
        if path.suffix in (".json", ".toml"):
            text = path.read_text()
            assert not [word for word in ('"/', "/home/", "/tmp/", "/Users/") if word in text]


def fractions(names: Sequence[str]) -> set[str]:
    values = (value for name in names for value in flat(result_of(name).record).values())
    return {in_words(value) for value in values if isinstance(value, tuple)}


@pytest.mark.parametrize(
    ("page", "part", "names"),
    [
        ("dagger-eot.md", "", PAGES["dagger_eot"][2]),
        ("cloak-variations.md", "", PAGES["cloak_variations"][2]),
        ("transfer.md", "### With a budget in pictures", ("transfer_views",)),
    ],
)
def test_fractions_in_tables_by_hand_are_those_of_the_artifacts(page: str, part: str, names: Sequence[str]) -> None:
    text = (ROOT / "docs" / page).read_text()
    text = text.partition(part)[2].partition("###")[0] if part else text
    assert set(FRACTION.findall(text)) <= fractions(names)
    assert FRACTION.search(text)


def test_the_transfer_matrix_in_the_guide_is_that_of_the_rows() -> None:
    text = (ROOT / "docs" / "transfer.md").read_text()
    matrix = text.partition("## The matrix")[2].partition("## Over views")[0]
    cells = re.findall(r"\d+/\d+, \d+/\d+", matrix)
    looks = result_of("transfer").record["looks"]
    counts = (
        [f"{look[key]['successes']}/{look[key]['total']}" for key in ("targeted", "untargeted")] for look in looks
    )
    assert Counter(cells) == Counter(map(", ".join, counts))


# The figures of README


def missed(name: str) -> str:
    rates = result_of(name).record["by_detector"]
    return f"car missed from {100 * rates[OUR[0]]['trigger_miss_rate']['rate']:.1f} % of cameras"


def from_one_view() -> str:
    """Attacks that take the own class away where the detector finds the clean object, and noise."""
    result, part = result_of("dagger_strict"), "The paper's ball and steps"
    members = {key for key, attack in result.record["attacks"].items() if attack["part"] == part}
    rows = result.tables[ROWS].filter(pl.col("attack").is_in(members), detector=OUR[0])
    recalled = rows.filter(pl.col("original_score") >= LEFT, splat=CLEAN).select("attack", "view")
    attacked = rows.filter(splat=ATTACKED).join(recalled, on=("attack", "view"))
    strict = attacked.filter(pl.col("target_score") >= REPORTED, pl.col("original_score") < LEFT)
    groups = [group for group in result.record["groups"] if group["part"] == part]
    noise = [sum(group[key] for group in groups) for key in ("noise_successes", "noise_draws")]
    return (
        f"succeeds in {len(strict)} of {len(attacked)} attacks | Faster R-CNN, white box, one view; "
        f"noise: {noise[0]} of {noise[1]}"
    )


def from_all_cameras() -> str:
    attacks = [attack for name, attack in result_of("dagger_eot_pairs").record["attacks"].items() if OUR[0] in name]
    held = sorted(attack["rate"]["successes"] for attack in attacks)
    noise = [sum(attack["noise_rate"][key] for attack in attacks) for key in ("successes", "total")]
    return (
        f"{held[0]} to {held[-1]} of 60 held-out views | six pairs, one detector, white box; "
        f"noise: {noise[0]} of {noise[1]}"
    )


def transferred() -> str:
    looks = [
        look["targeted"]
        for look in result_of("transfer").record["looks"]
        if " + " not in look["labels"]["detectors"] and not look["white_box"]
    ]
    counts = [sum(look[key] for look in looks) for key in ("successes", "total")]
    return f"attacks on one detector deceive another one from the same view in {counts[0]} of {counts[1]} runs"


def grown() -> str:
    values = result_of("poison_splat").record["values"]
    (one,) = (value for value in values if (value["part"], value["value"]) == ("eps", "16"))
    return f"{one['splats']['attacked']['times']['gaussians']['mean']:.1f} times the Gaussians"


def test_readme_says_what_the_rows_give() -> None:
    text = " ".join((ROOT / "README.md").read_text().split())
    cloak = (missed("cloak_car_stealthy"), missed("cloak_car_layers"))
    for sentence in (*cloak, from_one_view(), from_all_cameras(), transferred(), grown()):
        assert sentence in text
