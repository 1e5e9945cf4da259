"""With the clean file at hand, an audit says what changed since, whatever became of the
order of the rows.
"""

import json
from pathlib import Path
from typing import Any

import pytest
import torch
from PIL import Image

from attacks import cli
from attacks.audits import recognition
from mi_splat.audit import Audit, linting
from mi_splat.audit.against import Changes, changes
from mi_splat.audit.files import document
from mi_splat.audit.sarif import sarif
from mi_splat.io import save_splat
from mi_splat.scene import GaussianScene, merge
from mi_splat.selection.select import load_mask
from tests.audit.accounts import account, cone
from tests.audit.recogniser import Painted
from tests.audit.scenes import standing


@pytest.fixture(scope="module")
def clean() -> GaussianScene:
    return standing("suitcase", count=600).scene.with_degree(1)


@pytest.fixture(scope="module")
def edited(clean: GaussianScene) -> GaussianScene:
    """A tenth of the Gaussians has another colour, a few are brighter from one side,
    one has moved.
    """
    sh = clean.sh.clone()
    means = clean.means.clone()
    sh[:80, 0] += 0.2
    sh[40:60, 2] -= 0.3
    means[100] += 0.001
    return clean.replace(sh=sh, means=means)


def row(difference: Changes, attribute: str) -> list[float]:
    return next(
        [item.count, item.most]
        for item in difference.attributes
        if item.attribute == attribute
    )


def test_changes_are_counted_by_attribute(
    clean: GaussianScene, edited: GaussianScene
) -> None:
    difference = changes(edited, clean)
    assert difference.by_order
    assert torch.equal(
        difference.changed.nonzero()[:, 0], torch.tensor([*range(80), 100])
    )
    assert torch.equal(difference.mask, difference.changed)
    assert row(difference, "colour") == pytest.approx([80, 0.2 * 0.2821], abs=1e-4)
    assert row(difference, "SH of degree 1") == pytest.approx([20, 0.3], abs=1e-5)
    assert row(difference, "position") == pytest.approx([1, 0.001 * 3**0.5], abs=1e-5)
    assert row(difference, "opacity") == row(difference, "scale") == [0, 0]
    assert row(difference, "rotation")[0] == 0
    assert len(difference.cameras) == 2


def test_rows_may_be_shuffled_dropped_and_added(
    clean: GaussianScene, edited: GaussianScene
) -> None:
    order = torch.randperm(len(edited), generator=torch.Generator().manual_seed(0))[
        :-50
    ]
    extra = edited.select(slice(0, 5))
    extra = extra.replace(means=extra.means + 3.0)
    difference = changes(merge(edited.select(order), extra), clean)
    assert not difference.by_order
    assert torch.equal(difference.changed[:-5], changes(edited, clean).changed[order])
    assert bool(difference.changed[-5:].all())
    assert (difference.added, difference.removed) == (5, 50)


def test_a_copy_has_not_changed(clean: GaussianScene) -> None:
    difference = changes(clean, clean)
    assert not bool(difference.changed.any())
    assert difference.cameras == ()
    assert difference.in_words() == ["against the clean splat: nothing changed"]
    assert all(item.count == 0 for item in difference.attributes)


def test_the_command_writes_what_changed(
    clean: GaussianScene,
    edited: GaussianScene,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(linting, "SIZE", 256)
    monkeypatch.setattr(recognition, "Recognition", Painted)
    before = tmp_path / "clean.ply"
    after = tmp_path / "edited.ply"
    out = tmp_path / "out"
    save_splat(clean, before)
    save_splat(edited, after)
    arguments = ["audit", str(after), "--against", str(before)]
    assert cli.main([*arguments, "--strict", "--out", str(out)]) == 3
    assert "81 of" in capsys.readouterr().out
    record = json.loads((out / "result.json").read_text())
    assert record["against"]["changed"] == 81
    with Image.open(out / "against.png") as picture:
        assert picture.size == (2 * 384 + 8, 2 * 384 + 8)
    assert int(load_mask(out / "changed.npy", edited).sum()) == 81
    save_splat(clean.select(slice(0, 0)), before)
    assert cli.main(arguments) == 1
    assert (
        "--against: expected a splat with Gaussians, got none"
        in capsys.readouterr().err
    )
    save_splat(standing("person", count=400).scene, before)
    assert cli.main(arguments) == 1
    assert "expected the splat that the other was made from" in capsys.readouterr().err


# Audits as SARIF: the essentials of its schema, and which finding is of which rule


def run_of(*documents: dict[str, Any]) -> dict[str, Any]:
    """The run of a log, after the essentials of the schema were checked."""
    log = json.loads(json.dumps(sarif(documents), allow_nan=False))
    (run,) = log["runs"]
    rules = run["tool"]["driver"]["rules"]
    levels = {"error", "warning", "note"}
    assert (log["version"], log["$schema"][-16:]) == ("2.1.0", "sarif-2.1.0.json")
    ids = [rule["id"] for rule in rules]
    assert len(set(ids)) == len(ids)
    assert all(
        rule["shortDescription"]["text"] and rule["help"]["text"] for rule in rules
    )
    assert {rule["defaultConfiguration"]["level"] for rule in rules} <= levels
    for result in run["results"]:
        assert ids[result["ruleIndex"]] == result["ruleId"]
        assert result["level"] in levels
        assert result["message"]["text"].endswith(".")
        location = result["locations"][0]["physicalLocation"]
        artifact = location["artifactLocation"]
        assert run["artifacts"][artifact["index"]]["location"]["uri"] == artifact["uri"]
        assert location["region"]["startLine"] == 1
    return dict(run)


@pytest.mark.parametrize(
    ("judged", "rules"),
    [
        (account(cone("consistent"), count=4), []),
        (account(cone("differs"), count=4), [("differs", "note")]),
        (account(cone("contradicted"), count=4), [("contradicted", "error")]),
        (
            account(cone("contradicted"), cone("differs"), count=4),
            [("contradicted", "error"), ("differs", "note")],
        ),
    ],
)
def test_each_finding_is_of_its_rule(
    judged: Audit, rules: list[tuple[str, str]]
) -> None:
    run = run_of({"file": "a splat.ply", **document(judged)})
    assert [(result["ruleId"], result["level"]) for result in run["results"]] == rules
    (artifact,) = run["artifacts"]
    assert artifact["location"]["uri"] == "a%20splat.ply"
    assert artifact["properties"]["verdict"] == judged.answer
