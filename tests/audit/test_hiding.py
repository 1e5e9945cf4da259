"""The recipes of the page about the audit: sets of splats, and an attacker who knows
it.
"""

from pathlib import Path
from typing import Literal

import pytest
import torch

from mi_splat.render.renderer import Renderer
from scenes.recipes import audit_set
from scenes.recipes.audit_hiding import Hiding, Victim, hide
from tests.audit.scenes import direction, standing
from tests.project.documented_commands import ROOT

pytestmark = pytest.mark.shipped


@pytest.mark.parametrize("by", ["coefficients", "layers", "roof"])
def test_the_recipe_hides_from_inside_of_its_trigger(
    by: Literal["coefficients", "layers", "roof"],
) -> None:
    made = standing("suitcase", count=250)
    victim = Victim(
        scene=made.scene, rows=made.rows, label="suitcase", render=Renderer()
    )
    attacked = hide(victim, Hiding(by=by, half_width=40.0))
    changes = []
    for elevation in (88, 8):
        camera = victim.camera(direction(elevation, 30), size=48)
        with torch.no_grad():
            clean, changed = (
                victim.render(scene, camera) for scene in (victim.scene, attacked)
            )
        changes.append(float((clean - changed).abs().mean()))
    assert changes[0] > (0.5 if by == "roof" else 2) * changes[1]


def test_the_table_of_the_page_follows_from_the_rows() -> None:
    page = (ROOT / "docs" / "audit-measured.md").read_text()
    rows = audit_set.read(ROOT / "docs/tables/audit_set.csv")
    off = [
        float(row["off"])
        for row in rows
        if row["off"] and row["verdict"] == "hidden look"
    ]
    found = [
        *audit_set.lines(rows),
        f"{sum(one <= 10 for one in off)} of {len(off)} hidden",
    ]
    assert len(found) > 10
    assert not [line for line in found if line not in page]
    for name in {row["set"] for row in rows}:
        area = "{:.3f} ({:.3f} to {:.3f})".format(
            *audit_set.ranked([row for row in rows if row["set"] == name])
        )
        assert area in page


def test_what_hides_ranks_above_what_does_not_and_failed_attacks_do_not_count() -> None:
    rows: list[audit_set.Row] = [
        {
            "file": "hidden side/x",
            "strength": "1.0",
            "evidence": "2",
            "verdict": "hidden look",
            "set": "test",
        },
        {
            "file": "hidden side/y",
            "strength": "0.1",
            "evidence": "0",
            "verdict": "nothing found",
            "set": "test",
        },
        {
            "file": "honest ring 20/x",
            "strength": "",
            "evidence": "3",
            "verdict": "suspicious",
            "set": audit_set.HELD,
        }
        | {"with_cameras": "nothing found", "evidence_with_cameras": "0"},
        {
            "file": "honest ring 45/y",
            "strength": "",
            "evidence": "1",
            "verdict": "nothing found",
            "set": "test",
        },
    ]
    assert audit_set.ranked(rows)[0] == 0.5
    assert list(audit_set.lines(rows)) == [
        "| all that hide | 1, 1 of 1 | - | - |",
        "| all honest | 0, 0 of 1 | 0, 1 of 1 | 0, 0 of 1 |",
        "| hidden side | 1, 1 of 1 | - | - |",
        "| honest ring | 0, 0 of 1 | 0, 1 of 1 | 0, 0 of 1 |",
    ]


def test_the_sets_share_no_file_and_every_kind_of_edit_can_be_made(
    tmp_path: Path,
) -> None:
    sets = [dict(make()) for make in audit_set.SETS.values()]
    names = [set(one) - {"honest room/room"} for one in sets]
    assert len(set.union(*names)) == sum(map(len, names))
    edits = {
        name: item
        for name, item in sets[0].items()
        if name.endswith("/elephant") and name.startswith("hidden")
    }
    clean = standing("elephant", count=2500).scene
    for name, item in edits.items():
        if isinstance(item, audit_set.Coded):
            scene, about = item.make(tmp_path)
            assert about == {"strength": 1.0}
            assert len(scene) >= len(clean), name
