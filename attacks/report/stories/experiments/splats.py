"""Experiments that look at a study's splats again: other distances, other formats, and the surroundings."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

from attacks.rate import Rate
from attacks.report.section import Chart, Figure, Line, Point, Section, Table, doubts_of
from attacks.report.stories.experiments.documents import Document, Row, matching, section
from attacks.report.wording import counted, counts, listed, number, percent, plural, pooled

_PLACES = {"overhead": "well inside the trigger", "elsewhere": "outside of all triggers"}
_USUAL, _SAVED = 1.0, ".ply"


def read_distances(path: Path, document: Document) -> Section:
    """The section of `cloak-experiment distance`.

    Args:
        path: The JSON file.
        document: What is in it.
    """
    rows: Sequence[Row] = document["found"]
    names = list(dict.fromkeys(row["detector"] for row in rows))

    def missed(splat: str, factor: float, cameras: str = "overhead") -> Rate:
        return pooled(map(_missed, matching(rows, splat=splat, distance=factor, cameras=cameras)))

    rate, control = missed("cloaked", _USUAL), missed("clean", _USUAL)
    factors = sorted({float(row["distance"]) for row in rows})
    each = [Figure(label=f"the same from {one:g} times the distance", rate=missed("cloaked", one)) for one in factors]
    return section(
        path,
        document,
        kind="CLOAK from other distances",
        done=(
            f"{listed(names)} looked at the clean and at the cloaked splat from held-out cameras that were moved to "
            f"{factors[0]:g} to {factors[-1]:g} times the distance of the training pictures."
        ),
        conclusion=(
            f"From the study's own distance the cloaked object is missed in {counts(rate)} views well inside the "
            f"trigger, the clean one in {counts(control)}. The curves say how this changes with the distance."
        ),
        headline=Figure(
            label="cloaked splat: object missed well inside the trigger, at the study's distance", rate=rate
        ),
        control=Figure(label="clean splat: object missed there", rate=control) if control.total else None,
        figures=[
            *each,
            Figure(
                label="cloaked splat: object missed outside of all triggers", rate=missed("cloaked", 1.0, "elsewhere")
            ),
        ],
        warnings=[*doubts_of(rate, control, what="views"), *_several(names)],
        charts=[_by_distance(rows, name) for name in names],
        tables=[_counts(rows, "distance", "times the distance", name) for name in names],
    )


def read_formats(path: Path, document: Document) -> Section:
    """The section of `cloak-experiment formats`.

    Args:
        path: The JSON file.
        document: What is in it.
    """
    rows: Sequence[Row] = document["found"]
    names, forms = (list(dict.fromkeys(row[key] for row in rows)) for key in ("detector", "form"))

    def missed(form: str, cameras: str) -> Rate:
        return pooled(map(_missed, matching(rows, form=form, cameras=cameras)))

    first = _SAVED if _SAVED in forms else forms[0]
    rate, control = missed(first, "overhead"), missed(first, "elsewhere")
    inside = [missed(form, "overhead").fraction for form in forms]
    return section(
        path,
        document,
        kind="CLOAK in other file formats",
        done=(
            f"The cloaked splat went through {plural(len(forms), 'form')}: file formats, half precision, and fewer SH "
            f"bands. {listed(names)} then looked at each from held-out cameras."
        ),
        conclusion=(
            f"Over all forms the object is missed in {percent(min(inside))} to {percent(max(inside))} of the views "
            f"well inside the trigger ({first}: {counts(rate)}). A form in which it is found there undoes the attack."
        ),
        headline=Figure(label=f"cloaked splat as {first}: object missed well inside the trigger", rate=rate),
        control=Figure(label=f"the same splat, {_PLACES['elsewhere']}", rate=control),
        figures=[
            Figure(label=f"{form}: object missed well inside the trigger", rate=missed(form, "overhead"))
            for form in forms
            if form != first
        ],
        warnings=[*doubts_of(rate, control, what="views"), *_several(names)],
        charts=[_by_form(rows, forms, name) for name in names],
        tables=[_counts(rows, "form", "form", name) for name in names],
    )


def read_renderers(path: Path, document: Document) -> Section:
    """The section of `cloak-experiment renderers`.

    Args:
        path: The JSON file.
        document: What is in it.
    """
    return _by_condition(
        path,
        document,
        key="renderer",
        kind="CLOAK in other renderers",
        done="{names} looked at pictures of the clean and of the cloaked splat by {conditions}.",
        conclusion="Over all renderers the cloaked object is missed in {range} of the views well inside the trigger "
        "({first}, which it was trained with: {counts}).",
    )


def read_street(path: Path, document: Document) -> Section:
    """The section of `cloak-experiment street`.

    Args:
        path: The JSON file.
        document: What is in it.
    """
    return _by_condition(
        path,
        document,
        key="hour",
        kind="CLOAK on a street of meshes",
        done="The object of the clean and of the cloaked splat was put on a path-traced street of meshes. {names} "
        "looked at pictures of it under the sun of {conditions}.",
        conclusion="Over all hours the cloaked object is missed in {range} of the views well inside the trigger "
        "({first}: {counts}).",
    )


def _by_condition(path: Path, document: Document, *, key: str, kind: str, done: str, conclusion: str) -> Section:
    """The section of an experiment that looks at the clean and the cloaked splat under several conditions.

    Args:
        path: The JSON file.
        document: What is in it.
        key: Of a row, what names the condition.
        kind: Of the section.
        done: What was done; {names} are the detectors, {conditions} the conditions.
        conclusion: {range} are the lowest and the highest rate, {counts} is that of the {first} condition.
    """
    rows: Sequence[Row] = document["found"]
    names, conditions = (list(dict.fromkeys(row[by] for row in rows)) for by in ("detector", key))

    def missed(condition: str, splat: str) -> Rate:
        return pooled(map(_missed, matching(rows, **{key: condition}, splat=splat, cameras="overhead")))

    first = conditions[0]
    rate, control = missed(first, "cloaked"), missed(first, "clean")
    inside = [missed(condition, "cloaked").fraction for condition in conditions]
    between = f"{percent(min(inside))} to {percent(max(inside))}"
    return section(
        path,
        document,
        kind=kind,
        done=done.format(names=listed(names), conditions=listed(conditions)),
        conclusion=conclusion.format(range=between, first=first, counts=counts(rate)),
        headline=Figure(label=f"{first}, cloaked splat: object missed well inside the trigger", rate=rate),
        control=Figure(label=f"{first}, clean splat: object missed there", rate=control) if control.total else None,
        figures=[
            Figure(label=f"{condition}, {splat} splat: object missed well inside the trigger", rate=rate)
            for condition in conditions[1:]
            for splat in ("cloaked", "clean")
            for rate in [missed(condition, splat)]
        ],
        warnings=[*doubts_of(rate, control, what="views"), *_several(names)],
        tables=[_counts(rows, key, key, name) for name in names],
    )


def read_surroundings(path: Path, document: Document) -> Section:
    """The section of `cloak-experiment surroundings`.

    Args:
        path: The JSON file.
        document: What is in it.
    """
    rows: Sequence[Row] = document["found"]
    inside, elsewhere = rows[0], rows[-1]
    loss = None
    if inside["psnr_mean"] is not None and elsewhere["psnr_mean"] is not None:
        loss = elsewhere["psnr_mean"] - inside["psnr_mean"]
    return section(
        path,
        document,
        kind="CLOAK beside the object",
        done=(
            "The cloaked splat's pictures were compared with the clean splat's, outside of the object, from held-out "
            "cameras inside the hiding trigger and elsewhere."
        ),
        conclusion=(
            f"Beside the object both splats show the same to {number(inside['psnr_mean'], unit='dB')} inside the "
            f"trigger and to {number(elsewhere['psnr_mean'], unit='dB')} elsewhere"
            f"{'' if loss is None else f', a difference of {loss:.1f} dB'}. Who stands in the trigger sees the former."
        ),
        headline=Figure(
            label="inside the trigger: PSNR beside the object", words=number(inside["psnr_mean"], unit="dB")
        ),
        control=Figure(label="elsewhere: PSNR beside the object", words=number(elsewhere["psnr_mean"], unit="dB")),
        warnings=[
            *(f"No camera {row['cameras']}: nothing was compared there" for row in rows if not row["of"]),
            *(f"Few pictures {row['cameras']}: {row['of']}" for row in rows if 0 < row["of"] < 10),
        ],
        tables=[
            Table(
                caption="PSNR of the cloaked splat against the clean one, outside of the object",
                head=("cameras", "pictures", "mean", "lowest", "highest"),
                rows=tuple(
                    (
                        row["cameras"],
                        str(row["of"]),
                        *(number(row[f"psnr_{which}"], unit="dB") for which in ("mean", "lowest", "highest")),
                    )
                    for row in rows
                ),
            )
        ],
    )


def _missed(row: Row) -> Rate:
    return Rate(successes=int(row["of"]) - int(row["found"]), total=int(row["of"]))


def _found(row: Row) -> Rate:
    rate = Rate(successes=int(row["found"]), total=int(row["of"]))
    if not 0 <= rate.successes <= rate.total:
        raise ValueError(f"a rate of {rate.successes} of {rate.total}")
    return rate


def _several(names: Sequence[str]) -> Iterator[str]:
    if len(names) > 1:
        yield "The rates at the top pool all detectors: look at each"


def _by_distance(rows: Sequence[Row], name: str) -> Chart:
    kinds = (
        ("cloaked", "overhead", "attack"),
        ("clean", "overhead", "control"),
        ("cloaked", "elsewhere", "other"),
    )
    lines = []
    for splat, cameras, role in kinds:
        own = matching(rows, detector=name, splat=splat, cameras=cameras)
        points = tuple(Point.of(float(row["distance"]), _found(row)) for row in own if row["of"])
        lines.append(Line(name=f"{splat}, {_PLACES[cameras]}", role=role, points=points))  # type: ignore[arg-type]
    return Chart(
        title=f"Found by {name}, by distance",
        caption="Bands are 95 % intervals; 1 is the distance of the training pictures.",
        x_label="distance, of the study's",
        y_label="views in which it is found",
        lines=tuple(lines),
    )


def _by_form(rows: Sequence[Row], forms: Sequence[str], name: str) -> Chart:
    lines = []
    for cameras, role in (("overhead", "attack"), ("elsewhere", "control")):
        own = {row["form"]: row for row in matching(rows, detector=name, cameras=cameras)}
        points = tuple(
            Point.of(i, _found(own[form])) for i, form in enumerate(forms) if form in own and own[form]["of"]
        )
        lines.append(Line(name=_PLACES[cameras], role=role, points=points))  # type: ignore[arg-type]
    return Chart(
        title=f"Found by {name}, by form",
        caption="Bars are 95 % intervals. The attack works where the object is not found inside the trigger.",
        x_label="form",
        y_label="views in which it is found",
        lines=tuple(lines),
        ticks=tuple(forms),
        connected=False,
    )


def _counts(rows: Sequence[Row], key: str, head: str, name: str) -> Table:
    """A row for each value of a key, a column for each splat and group of cameras."""
    own = matching(rows, detector=name)
    groups = list(dict.fromkeys((row.get("splat", "cloaked"), row["cameras"]) for row in own))
    cells = []
    for value in dict.fromkeys(row[key] for row in own):
        here = {(row.get("splat", "cloaked"), row["cameras"]): row for row in own if row[key] == value}
        psnr = [number(here[group].get("psnr"), unit="dB") for group in groups] if "psnr" in own[0] else []
        rates = [counted(_found(here[group])) for group in groups]
        cells.append((f"{value:g}" if isinstance(value, float) else str(value), *rates, *psnr))
    heads = [f"{splat}, {_PLACES.get(cameras, cameras)}" for splat, cameras in groups]
    more = [f"PSNR, {_PLACES.get(cameras, cameras)}" for _, cameras in groups] if "psnr" in own[0] else []
    return Table(caption=f"Found by {name}", head=(head, *heads, *more), rows=tuple(cells))
