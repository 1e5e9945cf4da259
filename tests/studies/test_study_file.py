"""Study files: what varies becomes points, and what cannot be is refused."""

import math
from typing import Any

import pytest

from attacks.studies.running import Attempt, bisection
from attacks.studies.study_file import Point, merged, study_of
from mi_splat.errors import InvalidValueError


def points(**table: Any) -> list[Point]:
    return study_of({"study": "dagger", **table}, "toy").points


def test_an_axis_sets_one_field_or_several_and_the_first_is_the_slowest() -> None:
    pairs = [{"name": "a", "object": "car", "target": "tv"}, {"object": "sign"}]
    made = points(
        attack={"norm": "l2"},
        matrix={"seed": [0, 1], "attack.eps": [1.0], "pair": pairs},
    )
    assert [(point.labels["seed"], point.labels["pair"]) for point in made] == [
        (0, "a"),
        (0, "object sign"),
        (1, "a"),
        (1, "object sign"),
    ]
    assert made[0].settings == {
        "attack": {"norm": "l2", "eps": 1.0},
        "seed": 0,
        "object": "car",
        "target": "tv",
    }
    assert points(matrix={"attack": {"eps": [1.0]}})[0].labels == {"attack.eps": 1.0}


def test_cases_have_settings_and_axes_of_their_own() -> None:
    cases = [
        {"name": "all"},
        {
            "name": "linf",
            "attack": {"norm": "linf"},
            "matrix": {"attack.eps": [0.1, 0.2], "camera": [1]},
        },
    ]
    made = points(
        attack={"norm": "l2", "steps": 3},
        matrix={"attack.eps": [5.0], "seed": [0]},
        case=cases,
    )
    assert [(point.part, *point.labels.values()) for point in made] == [
        ("all", 5.0, 0),
        ("linf", 0.1, 0, 1),
        ("linf", 0.2, 0, 1),
    ]
    assert made[2].settings == {
        "attack": {"norm": "linf", "steps": 3, "eps": 0.2},
        "seed": 0,
        "camera": 1,
    }


def test_an_entry_of_a_list_is_changed_by_its_name() -> None:
    attacks = [{"name": "over", "emphasis": 1}, {"name": "rear", "emphasis": 2}]
    assert merged({"attack": attacks}, {"attack": {"rear": {"emphasis": 5}}}) == {
        "attack": [attacks[0], {"name": "rear", "emphasis": 5}]
    }
    with pytest.raises(InvalidValueError, match="did you mean rear"):
        merged({"attack": attacks}, {"attack": {"reer": {}}})


VALUES = (0.03, 0.05, 0.08, 0.12, 0.18, 0.25, 0.35, 0.5, 0.7, 1.0, 1.4)


def attempt(point: Point) -> Attempt:
    return Attempt(point=point, title="", jobs={})


@pytest.mark.parametrize("needed", [*VALUES, math.inf])
def test_a_bisection_finds_the_smallest_in_few_looks(needed: float) -> None:
    bisect = {"field": "attack.eps", "values": list(VALUES)}
    searched = points(bisect=bisect, matrix={"attack.eps": [7.0], "seed": [1]})
    assert [(point.bisected, *point.labels.values()) for point in searched] == [
        ("attack.eps", 1, value) for value in VALUES
    ]
    known: dict[float, bool] = {}

    def suffices(tried: Attempt, _: object) -> bool:
        value = tried.point.labels["attack.eps"]
        known[value] = value >= needed
        return known[value]

    looks = list(bisection([attempt(point) for point in searched], suffices))
    assert len(looks) == len(known) <= 4
    assert (
        min((value for value, enough in known.items() if enough), default=math.inf)
        == needed
    )
    assert {point.settings["seed"] for point in searched} == {1}


def test_a_bisection_ends_at_an_attempt_that_failed() -> None:
    searched = points(bisect={"field": "attack.eps", "values": list(VALUES)})
    assert (
        len(
            list(
                bisection(
                    [attempt(point) for point in searched], lambda tried, results: None
                )
            )
        )
        == 1
    )


def test_the_file_of_one_study_of_cloak_is_a_study() -> None:
    (point,) = study_of({"name": "x", "attack": [{"name": "above"}]}, "toy").points
    assert point.settings["attack"] == [{"name": "above"}]
    assert study_of({"attack": [{"name": "above"}]}, "toy").kind == "cloak"


def test_judges_are_every_combination() -> None:
    evaluation = {"views": 3, "matrix": {"detector": ["a", "b"], "condition": ["ray"]}}
    evaluations = study_of(
        {"study": "dagger", "evaluate_with": evaluation}, "toy"
    ).evaluations
    assert [point.settings["detector"] for point in evaluations] == ["a", "b"]
    assert {point.settings["views"] for point in evaluations} == {3}
    assert study_of({"study": "dagger"}, "toy").evaluations == ()
    assert (
        len(
            study_of(
                {"study": "dagger", "evaluate_with": {"condition": "ray"}}, "toy"
            ).evaluations
        )
        == 1
    )


def test_some_parts_of_a_study() -> None:
    study = study_of({"study": "dagger", "case": [{"name": "a"}, {"name": "b"}]}, "toy")
    assert list(study.of(["b"]).parts) == ["b"]
    assert study.of(()) is study
    with pytest.raises(
        InvalidValueError, match="part of toy: expected a or b, got bb; did you mean b"
    ):
        study.of(["bb"])


def test_the_old_name_of_a_table_is_refused_with_the_new_one() -> None:
    with pytest.raises(InvalidValueError, match=r"expected evaluate_with, got judge"):
        study_of({"study": "dagger", "judge": {"condition": "ray"}}, "toy")
