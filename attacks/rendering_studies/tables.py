"""Tables of a rendering study: study.md for people, study.json for machines, study.png to look at."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from attacks.dagger.tables import grid
from attacks.dagger.transfer.matrix import weights
from attacks.rate import Rate
from attacks.rendering_studies.config import RenderingStudy
from attacks.rendering_studies.figure import draw_rates
from attacks.rendering_studies.rates import Group, Outcome, Record, image_psnr, outcomes
from mi_splat import provenance
from mi_splat.io.documents import save_json, save_text

KINDS = {
    "targeted": "The wanted class is reported",
    "untargeted": "The object's class is no longer reported",
}
SUMMARY, PAGE, FIGURE = "study.json", "study.md", "study.png"


def write_study(study: RenderingStudy, records: Sequence[Record], out: Path, *, toml: str = "") -> list[Path]:
    """Write study.md and study.json, and study.png where matplotlib is installed.

    Args:
        study: The study.
        records: What came of it.
        out: Folder of the study.
        toml: Text of its file, kept so that it can be repeated.

    Returns:
        The files written.
    """
    found = outcomes(records, confidence=study.confidence)
    save_text(markdown(study, records), out / PAGE)
    document = {
        "study": study.name,
        "question": study.question,
        "configuration": dataclasses.asdict(study),
        "toml": toml,
        "attacks": len(records),
        "outcomes": [outcome.as_dict() for outcome in found],
        "image_psnr": [{**dataclasses.asdict(group), "psnr": psnr} for group, psnr in image_psnr(records).items()],
        "weights": _weights(records),
        **provenance.origin(),
    }
    save_json(document, out / SUMMARY)
    paths = [out / PAGE, out / SUMMARY]
    if draw_rates(study.question, found, out / FIGURE):
        paths.append(out / FIGURE)
    return paths


def markdown(study: RenderingStudy, records: Sequence[Record]) -> str:
    """The tables as one Markdown page."""
    found = outcomes(records, confidence=study.confidence)
    seeds = ", ".join(map(str, sorted({record["job"]["config"]["seed"] for record in records})))
    pairs = "; ".join(
        dict.fromkeys(f"{pair.object.replace('_', ' ')} to {pair.target}, camera {pair.camera}" for pair in study.pairs)
    )
    lines = [
        f"# {study.question}",
        "",
        f"{len(records)} attacks: {pairs}; seeds {seeds}; no early stop. The detector that was attacked judges, on "
        f"8-bit pictures of the saved splat; a class counts from {study.confidence:g}. Rates are of the runs whose "
        "clean object is found under the same condition; in brackets the 95 % Wilson interval.",
        "",
    ]
    for detector, (kind, what) in itertools.product(study.detectors, KINDS.items()):
        own = [outcome for outcome in found if outcome.group.detector == detector]
        if own:
            lines += [f"## {what}: {detector}", "", *rate_table(own, kind), ""]
    lines += ["## How visible the attacks are", "", *_visibility(records), ""]
    marks = "; ".join(f"{name} {', '.join(some)}" for name, some in _weights(records).items())
    first = records[0]["attack"]
    versions = ", ".join(f"{name} {version}" for name, version in first["versions"].items())
    return "\n".join(
        [*lines, f"Weights: {marks}.", "", f"Versions: {versions}; {first['variant']}; commit {first['commit']}.", ""]
    )


def rate_table(found: Sequence[Outcome], kind: str) -> list[str]:
    """One row for each condition, one column for each group of attacks, and the noise of all of them."""
    groups = list(dict.fromkeys(outcome.group for outcome in found))
    by_place = {(outcome.group, outcome.condition): outcome for outcome in found}
    body = []
    for condition in dict.fromkeys(outcome.condition for outcome in found):
        here = [by_place.get((group, condition)) for group in groups]
        marks = ["-" if one is None else _said(getattr(one, kind)) for one in here]
        control = [getattr(one, f"noise_{kind}") for one in here if one is not None]
        body.append([condition, *marks, _counts(control)])
    return grid(["judged under", *map(_column, groups), "random noise"], body)


def _column(group: Group) -> str:
    return f"{group.source}: {group.ball}"


def _visibility(records: Sequence[Record]) -> list[str]:
    body = [[group.detector, group.source, group.ball, f"{psnr:.1f}"] for group, psnr in image_psnr(records).items()]
    return grid(["detector", "attacked in", "ball", "PSNR, dB (median)"], body)


def _said(rate: Rate) -> str:
    low, high = rate.interval
    return f"{rate.successes}/{rate.total} ({low:.2f} to {high:.2f})" if rate.total else "0/0"


def _counts(rates: Sequence[Rate]) -> str:
    return f"{sum(rate.successes for rate in rates)}/{sum(rate.total for rate in rates)}"


def _weights(records: Sequence[Record]) -> dict[str, Any]:
    """Fingerprints of the detectors' weights, by name."""
    return weights(records)
