"""Keys: every field flips the keys that depend on it and no other, and a configuration comes back from its text."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mi_splat.errors import InvalidValueError
from mi_splat.import_closure import closure
from mi_splat.ledger import Job, Ledger, running
from mi_splat.ledger.values import canonical, decoded, encoded
from tests.ledger.kinds.configs import NumbersConfig, Shift, Sign

NUMBERS = "tests.ledger.kinds.numbers"
OTHER: dict[str, Any] = {"values": (1.0, 2.0), "name": "total", "most": 0, "loud": True, "by": 0.5, "sign": Sign.MINUS}


def changed(config: Any) -> Iterator[tuple[str, Any]]:
    """The configuration with another value in each of its fields, those of its parts too."""
    for field in dataclasses.fields(config):
        value = getattr(config, field.name)
        if dataclasses.is_dataclass(value):
            yield from ((name, dataclasses.replace(config, **{field.name: part})) for name, part in changed(value))
        else:
            yield field.name, dataclasses.replace(config, **{field.name: OTHER[field.name]})


def keys(folder: Path, config: NumbersConfig) -> dict[str, str]:
    """Keys of a small graph of jobs, one of which has the configuration."""
    ledger = Ledger(folder)
    first, beside = Job(kind=NUMBERS, config=config), Job(kind=NUMBERS, config=NumbersConfig(values=(9.0,)))
    after = Job(kind=NUMBERS, config=NumbersConfig(), inputs={"first": first})
    jobs = {"first": first, "beside": beside, "after": after}
    return {name: ledger.do(job).key for name, job in jobs.items()}


def test_every_field_flips_exactly_the_keys_that_depend_on_it(tmp_path: Path) -> None:
    usual = keys(tmp_path, NumbersConfig())
    names = set()
    for name, config in changed(NumbersConfig()):
        flipped = {job for job, key in keys(tmp_path, config).items() if key != usual[job]}
        # What the job leaves is the same whatever these three say, and so is what reads it.
        assert flipped == ({"first"} if name in ("name", "most", "loud", "sign") else {"first", "after"}), name
        names.add(name)
    assert names == set(OTHER)


def test_the_code_of_its_kind_is_in_the_key_and_the_ledger_is_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert not [name for name in closure(NUMBERS) if name.startswith("mi_splat.ledger")]
    usual = keys(tmp_path, NumbersConfig())
    monkeypatch.setattr(running, "code_digest", lambda kind: "0123456789abcdef")
    assert not set(keys(tmp_path, NumbersConfig()).values()) & set(usual.values())


@pytest.mark.parametrize("value", [1.0, 0.1 + 0.2, 5e-324, -0.0, math.inf, -math.inf])
def test_numbers_are_exact(value: float) -> None:
    back = decoded(json.loads(canonical(encoded(value))), ())
    assert (back, math.copysign(1, back)) == (value, math.copysign(1, value))
    assert canonical(encoded(1)) != canonical(encoded(1.0))


@given(
    st.builds(
        NumbersConfig,
        values=st.lists(st.floats(allow_nan=False)).map(tuple),
        shift=st.builds(Shift, by=st.floats(allow_nan=False), sign=st.sampled_from(Sign)),
        name=st.text(st.characters(exclude_categories=["Cs"], exclude_characters="\0")),
        most=st.none() | st.integers(-(1 << 63), (1 << 63) - 1),
    )
)
def test_a_configuration_comes_back_from_its_text(config: NumbersConfig) -> None:
    text = canonical(encoded(config))
    back = decoded(json.loads(text), closure(NUMBERS))
    assert back == config
    assert canonical(encoded(back)) == text


def test_a_field_that_is_new_has_its_default_and_one_that_is_gone_is_told() -> None:
    values = encoded(NumbersConfig(name="old"))
    del values["loud"]
    assert decoded(values, closure(NUMBERS)) == NumbersConfig(name="old")
    with pytest.raises(InvalidValueError, match="expected its fields, got colour"):
        decoded({**values, "colour": 1}, closure(NUMBERS))


@pytest.mark.parametrize(
    "name", ["os:PathLike", "subprocess:Popen", "tests.ledger.kinds.configs:nothing", "builtins:eval"]
)
def test_a_text_names_no_code_beside_the_configurations_of_its_kind(name: str) -> None:
    with pytest.raises(InvalidValueError, match="expected a dataclass or an enumeration of a module that the kind"):
        decoded({"class": name}, closure(NUMBERS))
