"""What the gate finds in a splat file, claim by claim: the job of a process that may be killed for it.

Rows are findings, so that another policy needs no second look; those of a killed job are in its partial folder.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mi_splat.audit.against import changes
from mi_splat.audit.auditing import audit
from mi_splat.audit.files import document, findings
from mi_splat.audit.gate import RESULT, ROWS, Claim, GateConfig, Row, fingerprint, sampled
from mi_splat.audit.linting import Lint, lint_file
from mi_splat.errors import MiSplatError
from mi_splat.io.documents import save_json
from mi_splat.io.errors import SplatFileError
from mi_splat.io.splat_files import load_stored
from mi_splat.scene import GaussianScene
from mi_splat.scene_files import open_scene

if TYPE_CHECKING:
    from mi_splat.ledger import Out

_CLAIM_OF: Mapping[str, Claim] = {
    **dict.fromkeys(("hidden-look", "suspicious-look", "fog", "occluder"), "hidden appearance"),
    **{"edited": "edits", "overdraw": "cost"},
}
"""The claim that a rule is about; rules of glTF are about what is readable, all others about the numbers."""


def run(config: GateConfig, inputs: Mapping[str, Path], out: Out) -> list[Row]:
    """Judge the file of a job, and keep what is found as it is found."""
    rows: list[Row] = []
    for row in _rows(config, inputs, out):
        rows.append({**{"claim": "", "rule": "", "severity": "", "reason": "", "judged": True}, **row})
        if row["claim"] in ("cost", "edits") and not row.get("rule"):  # before what takes long
            save_json({"rows": rows}, out.partial / ROWS)
    return rows


def _rows(config: GateConfig, inputs: Mapping[str, Path], out: Out) -> Iterator[Row]:
    """Findings of one claim after the other, each ended by a row without a rule."""
    path, stored, unread = inputs["splat"], None, ""
    try:
        stored = load_stored(path)
    except SplatFileError as error:
        unread = str(error)
    try:
        lint = lint_file(path, stored)
    except SplatFileError as error:
        yield {"claim": "readable", "rule": "unreadable", "severity": "error", "reason": unread or str(error)}
        yield {"claim": "readable"}
        return
    account = document(None, lint)
    yield from _found(account, ())
    known = {"fingerprint": fingerprint(stored.arrays), "gaussians": lint.gaussians} if stored is not None else {}
    yield {"claim": "readable", **known}
    if stored is None:
        return
    yield from ({"claim": claim} for claim in ("numbers", "cost"))
    yield from _looks(config, stored.scene, lint, account, out)
    if "clean" in inputs:
        yield from _provenance(stored.scene, inputs["clean"])


def _found(document: Mapping[str, Any], known: Iterable[str]) -> Iterator[Row]:
    """The findings of an account."""
    for name, severity, reason, _ in findings(document):
        rule = name.removeprefix("lint/")
        claim = "readable" if rule.startswith("gltf-") else _CLAIM_OF.get(rule, "numbers")
        if claim not in known:
            yield {"claim": claim, "rule": rule, "severity": severity, "reason": reason}


def _looks(config: GateConfig, scene: GaussianScene, lint: Lint, account: dict[str, Any], out: Out) -> Iterator[Row]:
    """What the audit finds in a splat that can be rendered."""
    unjudged, judged = "", None
    errors = [item.rule for item in lint.findings if item.severity == "error"]
    if errors:
        unjudged = f"the file has errors: {', '.join(errors)}"
    elif {"hidden appearance", "edits"} & {*config.claims}:
        try:
            judged = audit(sampled(scene, config.most_gaussians))
        except MiSplatError as error:
            unjudged = " ".join(str(error).split())
    if judged or unjudged:
        account = document(judged, lint, unjudged=unjudged)
    save_json(account, out / RESULT)
    if judged is None:
        yield from ({"claim": claim, "judged": False, "reason": unjudged} for claim in ("hidden appearance", "edits"))
        return
    yield from _found(account, ("readable", "numbers", "cost"))
    yield {"claim": "hidden appearance"}
    few = all(item.edit is None for item in judged.objects)
    yield {"claim": "edits", "judged": not few, "reason": "no object has enough Gaussians" if few else ""}


def _provenance(scene: GaussianScene, clean: Path) -> Iterator[Row]:
    """What changed since the file that is known to be clean."""
    try:
        changed = changes(scene, open_scene(clean).scene)
    except MiSplatError as error:
        yield {"claim": "provenance", "judged": False, "reason": " ".join(str(error).split())}
        return
    if bool(changed.changed.any()) or changed.removed:
        reason = "; ".join(changed.in_words())
        yield {"claim": "provenance", "rule": "changed", "severity": "warning", "reason": reason}
    yield {"claim": "provenance"}
