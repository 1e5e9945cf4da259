"""The generated tables of the documentation, and sentences that tell of results, are what the raw rows give."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from functools import cache
from typing import Any

import pytest

from attacks.artifacts.checking import Checked, check_artifact
from attacks.artifacts.figures import flat, in_words
from attacks.artifacts.kinds import known_kind
from tests.project.documented_commands import ROOT

TABLES = ROOT / "docs" / "tables"
FRACTION = re.compile(r"(?<![\w/.])(\d+/\d+)(?![\w/]|\.\d)")
WITHOUT = {
    *("cloak_car_colour.md", "cloak_car_occluder.md", "cloak_detection_curve.md", "cloak_variations.md"),
    *("dagger.md", "transfer.md"),
    *("study_between_renderers.md", "study_files.md", "study_gradients.md", "study_sun.md"),
}
"""Tables whose raw rows are not there any more."""


@cache
def checked(name: str) -> Checked:
    return check_artifact(ROOT / "docs" / "artifacts" / name)


@cache
def of_page(page: str) -> tuple[str, ...]:
    """The artifacts that name a page."""
    folders = sorted((ROOT / "docs" / "artifacts").iterdir())
    return tuple(one.name for one in folders if page in checked(one.name).contents.pages)


def parts(text: str) -> list[str]:
    """A page cut before each heading; what stands before the first is left out where there is one."""
    found = [part.strip() for part in re.split(r"^(?=## )", text, flags=re.MULTILINE)]
    return found[1:] if len(found) > 1 else found


def test_every_table_has_an_artifact_or_is_said_to_have_none() -> None:
    tables = {path.name for path in TABLES.glob("*.md")}
    assert {name for name in tables if not of_page(f"docs/tables/{name}")} == WITHOUT
    said = (ROOT / "docs" / "artifacts.md").read_text().partition("## Without an artifact")[2]
    assert not [name for name in WITHOUT if f"tables/{name}" not in said]


@pytest.mark.parametrize("page", sorted({path.name for path in TABLES.glob("*.md")} - WITHOUT))
def test_a_table_is_what_its_artifacts_give(page: str) -> None:
    given = []
    for name in of_page(f"docs/tables/{page}"):
        one = checked(name)
        make = known_kind(one.contents.kind, one.found.folder).page
        assert make is not None
        given += [part.strip() for part in re.split(r"^(?=## )", make(one.derived, one.contents), flags=re.MULTILINE)]
    given = [part for part in given if part]
    there = parts((TABLES / page).read_text())
    if len(there) == len(given) == 1:  # tables without headings, after what the page says of itself
        assert there[0].endswith(given[0])
    else:
        assert sorted(there) == sorted(given)


def fractions(*names: str) -> set[str]:
    found = (figure.value for name in names for figure in flat(checked(name).derived))
    return {in_words(value) for value in found if isinstance(value, tuple)}


def test_tables_by_hand_have_no_other_fractions() -> None:
    names = of_page("docs/tables/dagger_eot.md")
    page = (ROOT / "docs" / "dagger-eot.md").read_text()
    assert set(FRACTION.findall(page)) <= fractions(*names)
    part = (ROOT / "docs" / "transfer.md").read_text().partition("### With a budget in pictures")[2].partition("###")[0]
    assert len(set(FRACTION.findall(part)) & fractions("transfer_views")) > 10
    assert set(FRACTION.findall(part)) <= fractions("transfer_views")


def surrogate(derived: Mapping[str, Any]) -> list[str]:
    """What docs/cloak.md tells of a poison that a surrogate has corrected."""
    by = derived["by_detector"]

    def each(key: str) -> str:
        return " and ".join(f"{rate['successes']}/{rate['total']}" for rate in (one[key] for one in by.values()))

    return [
        f"missed from {each('trigger_miss_rate')} well inside, stop sign from {each('target_rate')}, "
        f"{derived['stealth']['surroundings_psnr_drop']:.2f} dB lost beside the car",
        f"transition of {derived['transition_degrees']:.1f} degrees",
    ]


def tried(derived: Mapping[str, Any]) -> list[str]:
    """What docs/dagger-eot.md tells of the searches before the last one."""
    found = {name: one["rate"]["successes"] for name, one in derived["attacks"].items()}

    def of(*beginnings: str) -> list[int]:
        return [count for start in beginnings for name, count in found.items() if name.startswith(f"{start}-pairs")]

    first = of("frcnn")
    (paper,), (strong,), (centernet,), (nanodet,) = of("ex_nd_paper"), of("ex_nd_strong"), of("ex2_cn1"), of("nd")
    longer = " and ".join(map(str, sorted(of("ex2_nd1", "ex4_nd1"))))
    return [
        f"all six pairs of `fasterrcnn_small` {min(first)} to {max(first)} of 60, NanoDet's elephant {nanodet})",
        f"seed 0: {paper} of 60 views after 150 steps, {longer} after 500",
        f"(with the loss of `--search strong` and 150 steps: {strong}). CenterNet: {centernet} after 400.",
    ]


SENTENCES: Mapping[str, tuple[str, Callable[[Mapping[str, Any]], list[str]]]] = {
    "cloak_car_surrogate": ("docs/cloak.md", surrogate),
    "dagger_eot_tried": ("docs/dagger-eot.md", tried),
}
"""Artifacts whose figures stand in sentences: the page, and the sentences as the rows give them."""


@pytest.mark.parametrize("name", SENTENCES)
def test_sentences_are_what_the_rows_give(name: str) -> None:
    page, tell = SENTENCES[name]
    text = " ".join((ROOT / page).read_text().split())
    assert [sentence for sentence in tell(checked(name).derived) if sentence not in text] == []
