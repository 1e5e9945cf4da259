"""The commands that repeat results: rendered as the results were, and honest about what older results do not hold."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from attacks.reporting.results import read_section
from tests.reporting.makers import options, write_held_out, write_sanity
from tests.reporting.results import write_dagger, write_evaluation


def without(path: Path, *keys: str) -> None:
    """Take keys out of a JSON, as if an older version had written it."""
    values = json.loads(path.read_text())
    path.write_text(json.dumps({key: value for key, value in values.items() if key not in keys}))


def test_commands_render_as_the_results_were_rendered(tmp_path: Path) -> None:
    rendered: dict[str, Any] = {"near": 0.3, "background": [0.0, 0.5, 1.0]}
    made = {
        "dagger": write_dagger(tmp_path / "dagger", **rendered),
        "evaluate": write_evaluation(tmp_path / "evaluate", **rendered, original="car"),
        "dagger-sanity": write_sanity(tmp_path / "sanity"),
    }
    for name, folder in made.items():
        section = read_section(folder)
        given = options(section)
        background = (0.0, 0.0, 1.0) if name == "dagger-sanity" else (0.0, 0.5, 1.0)
        assert (given.view.near, given.view.background) == (0.3, background)
        assert "--near" not in section.repeating
    assert options(read_section(made["evaluate"])).original == "car"
    sanity = options(read_section(made["dagger-sanity"]))
    assert (sanity.selection.object, sanity.view.cameras) == ("thing", (str(made["dagger-sanity"] / "sanity.json"),))


def test_older_results_are_read_and_their_gaps_told(tmp_path: Path) -> None:
    older = {
        "dagger": write_dagger(tmp_path / "dagger"),
        "evaluate": write_evaluation(tmp_path / "evaluate"),
        "dagger-sanity": write_sanity(tmp_path / "sanity"),
        "dagger-transfer": write_held_out(tmp_path / "transfer"),
    }
    origin = ("versions", "variant", "commit")
    without(older["evaluate"] / "evaluation.json", *origin)
    without(older["dagger-sanity"] / "sanity.json", "near", "background", "selection", "cameras")
    without(older["dagger-transfer"] / "held_out.json", "study", "scenes", "views", "weights", *origin)
    said = {name: read_section(folder) for name, folder in older.items()}
    for name in ("dagger", "evaluate", "dagger-sanity"):
        assert "does not store --near and --background" in said[name].repeating
        assert options(said[name]).view.near is None
    assert "add --object and --cameras" in said["dagger-sanity"].repeating
    assert "STUDY" in said["dagger-transfer"].repeating
    assert options(said["dagger-transfer"]).eot_study == Path("STUDY")
