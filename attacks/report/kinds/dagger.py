"""What `mi-splat dagger` leaves behind: an attack on one object, and studies of many
attacks.
"""

import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from attacks.objectives.relabel import Relabel
from attacks.objectives.suppression import Hide, Untargeted
from attacks.observe.rows import NOISE
from attacks.rate import Rate, number, percent, pooled
from attacks.report.section import (
    Chart,
    Figure,
    Line,
    Picture,
    Point,
    Section,
    capital,
    listed,
    settings,
    shared,
)
from attacks.studies.result import (
    KINDS,
    attacks_of,
    by_attack,
    by_part,
    tables,
    title_of,
    together,
)
from attacks.tables import Column, Table
from mi_splat.errors import counted

Record = Mapping[str, Any]

_AIMS: dict[str, tuple[type[Any], str, str]] = {
    "relabel": (Relabel, "to {}", "report {}"),
    "hide": (Hide, "to nothing", "report nothing"),
    "untargeted": (Untargeted, "to anything else", "report something else"),
}
"""By its name an objective, and what the attacker wants as part of a title and of a
sentence.
"""
_RATES = {
    "detector": "detector",
    "attacked: success": "success",
    "random noise: success": "noise",
    "no attack: success": "clean",
    "clean object found": "found_clean",
    "attacked object found": "found_attacked",
}
_CONDITIONS = (
    "scene",
    "selection",
    "cameras",
    "up",
    "reference",
    "background",
    "near",
    "scene_hash",
    "redraws",
)
_PICTURES = (
    (
        "detections.png",
        (
            "What the detector reports: before the attack on the left, after it on the"
            " right."
        ),
        True,
    ),
    ("difference.png", "What has changed, enlarged; grey is no change.", False),
    (
        "held_out.png",
        (
            "Held-out views all around: clean on the left of each pair, attacked on the"
            " right."
        ),
        True,
    ),
)
"""Files, their captions, and whether they are wide."""
FEW_DRAWS = 5
"""Draws of noise from which on they say something."""


def read_attack(folder: Path, record: Record) -> Section:
    """The section of an attack, from chosen cameras or from all of a region."""
    rate = Rate.of(record["rate"])
    noise = Rate.of(record["noise_rate"])
    draws = record["noise"]["draws"]
    config = record["config"]
    drawn = "by_azimuth" in record
    needed = config["required_views"]
    budget = config.get("image_psnr")
    judged = record["detectors"]
    views = counted(rate.total, "held-out view" if drawn else "view")
    wish = _wish(record, 2)
    radii = ", ".join(f"{eps:g} over {name}" for name, eps in record["radius"].items())
    title = _object_name(record)
    ball = f"a ball ({record['norm']}: {radii})"
    conclusion = [
        _first_sentence(record, ball, views, wish),
        (
            f"{capital(_control(record['config']))}: {noise.counts}."
            if noise.total
            else ""
        ),
        f"In the first view {_change(record['views'][0], record['target'])}.",
        "Other cameras, detectors and renderers were not evaluated.",
    ]
    return Section(
        kind=f"DAGGER, from {'all cameras of a region' if drawn else 'chosen cameras'}",
        title=f"{title} {_wish(record, 1)}{', all cameras' if drawn else ''}",
        done=(
            f"The Gaussians of one object ({title}: {record['object_gaussians']:,}"
            f" Gaussians, of which {record['changed_gaussians']:,} changed) were moved"
            " within"
            f" {ball}"
            f"{'' if budget is None else f', while the pictures keep {budget:g} dB'},"
            f" in at most {counted(config['steps'], 'step')}. The attacker knows the"
            f" weights. {views}"
            f" {'that the search has never seen ' if drawn else ''}judged the saved"
            " file in 8-bit pictures."
        ),
        conclusion=" ".join(filter(None, conclusion)),
        headline=Figure(
            label=f"{'held-out ' if drawn else ''}views with the aim reached: {wish}",
            rate=rate,
            note=(
                f"{'confidence' if record['target'] else 'score'}"
                f" {percent(record['score'])}"
            ),
        ),
        control=Figure(
            label=f"{_control(record['config'])}, on the same views", rate=noise
        ),
        figures=tuple(_attack_figures(record)),
        warnings=(
            *record["warnings"],
            *(
                [f"Few draws of noise: {draws}. Ask for more with --noise-draws"]
                if 0 < draws < FEW_DRAWS
                else []
            ),
        ),
        pictures=tuple(
            Picture(path=folder / name, caption=caption, wide=wide)
            for name, caption, wide in _PICTURES
        ),
        charts=(
            *(_by_angle(record, angle, needed) for angle in ("azimuth", "elevation")),
            _search(record),
        ),
        tables=(
            Table.of(
                "Each detector",
                _RATES,
                [
                    {"detector": name, **rates}
                    for name, rates in record["rates"].items()
                ],
            ),
            *(() if drawn else (_views(record),)),
        ),
        configuration=settings(
            {**config, **{name: record[name] for name in _CONDITIONS if name in record}}
            | {
                "weights": {
                    one["detector"]: one["detector_fingerprint"] for one in judged
                }
            }
        ),
    )


def _first_sentence(record: Record, ball: str, views: str, wish: str) -> str:
    """Whether the attack succeeded, which needs a clean object that is detected."""
    detectors = listed(list(record["rates"]))
    rate = Rate.of(record["rate"])
    detected = Rate.of(record["rate_if_detected"])
    if not detected.total:
        return (
            f"No success is counted: {detectors} did not detect the clean object at"
            f" confidence >= 0.5 in any of {views}. Within {ball} the attack made"
            f" {detectors} {wish} on the object in {rate.successes} of {views}."
        )
    needed = percent(record["config"]["required_views"])
    verdict = "succeeded" if record["success"] else "failed"
    among = (
        f"{detected.successes} of {counted(detected.total, 'view')} in which the clean"
        " object is detected"
    )
    if detected.total == rate.total:
        every = ""
    else:
        every = f", and in {rate.successes} of all {views}"
    made = f"within {ball} it made {detectors} {wish} on the object"
    return f"The attack {verdict}: {made} in {among}{every} ({needed} required)."


def _object_name(record: Record) -> str:
    """The name of the attacked object, or else the first class that was reported on
    it.
    """
    selection = record.get("selection")
    if isinstance(selection, Mapping) and "object" in selection:
        return str(selection["object"])
    originals = (
        str(rates["original"])
        for rates in record["rates"].values()
        if rates.get("original")
    )
    return next(originals, "the selection")


def _wish(record: Record, part: int) -> str:
    """What the attacker wants, as part of a title (1) or of a sentence (2)."""
    name = record["objective"]
    if name in _AIMS:
        words = _AIMS[name][part]
    else:
        words = ("", f"to its aim, {name}", f"reach its aim, {name},")[part]
    return str(words).format(record["target"])


def _change(view: Record, target: str | None) -> str:
    """What a detector reported before and after an attack."""
    after = [f"{target} at {percent(view['target_confidence'])}"] if target else []
    if view["original"] not in (None, target):
        after.append(f"{view['original']} at {percent(view['original_confidence'])}")
    known = " and ".join(after) or "nothing known"
    return (
        f"{view['detector']} reported {_before(view, ' at ')} on the object before, and"
        f" {known} after it"
    )


def _before(view: Record, between: str = " ") -> str:
    if view["original"]:
        return f"{view['original']}{between}{percent(view['clean_confidence'])}"
    return "nothing"


def _attack_figures(record: Record) -> Iterator[Figure]:
    """Other rates, what the pictures lost, the size of the change, steps and time."""
    for name, rates in record["rates"].items() if len(record["rates"]) > 1 else ():
        yield Figure(label=name, rate=Rate.of(rates["success"]))
    yield Figure(
        label="no attack, on the same views", rate=Rate.of(record["clean_rate"])
    )
    for name, control in record.get("control_rates", {}).items():
        yield Figure(label=f"{name}, on the same views", rate=Rate.of(control))
    yield Figure(
        label="success without another class of more confidence",
        rate=Rate.of(record["unambiguous_rate"]),
    )
    image = record["image"]
    note = "PSNR of the mean squared error over all views; 26 is easily seen, 40 hardly"
    yield Figure(
        label="pictures, attacked against clean",
        words=number(record["image_psnr"], unit="dB"),
        note=note,
    )
    yield from Figure.each(
        {
            "the same on the object": number(image["psnr_object"], unit="dB"),
            **{
                f"the same with {name}": _least(values)
                for name, values in record.get("control_psnr", {}).items()
            },
            "largest change beside the object (1 is all)": f"{image['outside']:.3f}",
            "Gaussians changed, of the object's": (
                f"{record['changed_gaussians']:,} of {record['object_gaussians']:,}"
            ),
            **{
                f"size of the change, {name}": f"{used:.3g}"
                for name, used in record["used_in_file"].items()
            },
            "steps taken": f"{record['steps']} of {record['config']['steps']}",
            "best score of the noise": percent(
                max(record["noise"]["scores"], default=0.0)
            ),
            "time": number(record["seconds"], ".0f", "s"),
        }
    )


def _control(config: Record) -> str:
    """What the control of an attack is called; before there were several it was noise
    of the attack's norm.
    """
    if "controls" in config:
        return "random noise that changes the object as much"
    return "random noise of the same norm"


def _least(values: Sequence[float | None]) -> str:
    known = [value for value in values if value is not None]
    if known:
        return number(min(known), unit="dB")
    return "-"


def _views(record: Record) -> Table:
    """Every view as every detector sees it."""
    cameras = record.get("cameras") or []
    wanted = record["target"] or "target"

    def confidence(key: str) -> Column[tuple[int, Record]]:
        return lambda row: None if row[1].get(key) is None else percent(row[1][key])

    columns: dict[str, Column[tuple[int, Record]]] = {
        "camera": lambda row: (
            cameras[row[0] % len(cameras)] if cameras else f"view {row[0]}"
        ),
        "detector": lambda row: row[1]["detector"],
        "before": lambda row: _before(row[1]),
        "the same class after": confidence("original_confidence"),
        f"{wanted} before": confidence("target_confidence_clean"),
        f"{wanted} after": confidence("target_confidence"),
        "success": lambda row: row[1]["success"],
    }
    return Table.of("Every view", columns, enumerate(record["views"]))


def _search(record: Record) -> Chart:
    """The score over the steps of the search, a line for each run."""
    runs: dict[int, list[Point]] = {}
    for line in record["trace"]:
        if "score" in line:
            runs.setdefault(line["restart"], []).append(
                Point(float(line["index"]), line["score"])
            )
    return Chart(
        title="The search",
        caption="Score at each step that was judged.",
        x_label="step",
        y_label="score",
        lines=tuple(
            Line(
                name=f"run {run}" if len(runs) > 1 else "score",
                role="attack",
                points=tuple(points),
            )
            for run, points in list(runs.items())[:6]
            if len(points) > 1
        ),
    )


def _by_angle(record: Record, angle: str, needed: float) -> Chart:
    parts = [part for part in record.get(f"by_{angle}", ()) if part["total"]]
    return Chart(
        title=f"Success by {angle}",
        caption=(
            "Held-out views in equal parts of the region; bands are 95 % intervals."
        ),
        x_label=f"{angle} of the camera, degrees",
        y_label="views with success",
        lines=(Line.over("attacked", "attack", parts if len(parts) > 1 else ()),),
        level=(needed, "asked for"),
    )


# Studies of many attacks, and what others see of them

_NUMBER = re.compile(r"\d+(\.\d+)?")
_JUDGES = {True: "attacked detectors", False: "detectors that were not attacked"}


def read_study(folder: Path, record: Record) -> Section:
    """The section of a study."""
    attacks = list(attacks_of(record).values())
    label, counting, lines, key = _headline(record)
    rate = pooled(line[key] for line in lines)
    noise = pooled(_noise(line, key) for line in lines)
    beside = _control(attacks[0]["settings"].get("attack", {}))
    control = f"; {beside}: {noise.counts}" if noise.total else ""
    names = sorted({name for attack in attacks for name in attack["sources"]})
    return Section(
        kind="DAGGER, a study",
        title=f"{record['name']}, {counted(len(attacks), 'attack')}",
        done=(
            f"{record.get('question', '')} {counted(len(attacks), 'attack')} on"
            f" {listed(names)}. Each is judged on the saved file, in 8-bit pictures,"
            " beside random noise."
        ).strip(),
        conclusion=(
            f"{capital(label)}: {rate.counts}{control}. Views of one attack are not"
            " independent. This says nothing of other detectors, objects or budgets."
        ),
        headline=Figure(label=label, rate=rate),
        control=Figure(label=beside, rate=noise),
        counting=counting,
        figures=tuple(_study_figures(record)),
        warnings=(*_warnings(attacks), *_doubts(record["looks"])),
        charts=tuple(_charts(record)),
        tables=tuple(tables(record)),
        configuration=shared(
            [
                *(attack["settings"] for attack in attacks),
                {"weights": record["detectors"]},
            ]
        ),
    )


def _headline(record: Record) -> tuple[str, str, list[Record], str]:
    """The figure that matters: its name, what it counts, the lines that it is of, and
    their key.

    It is that of the attacks of the first part; of a study of looks, whose attacks have
    no control of their own, that of detectors that were not attacked, if there are
    such.
    """
    groups = record["groups"]
    looks = record["looks"]
    members = [group for group in groups if group["part"] == groups[0]["part"]]
    if members and (
        not looks or pooled(_noise(group, _key(group)) for group in members).total
    ):
        part = members[0]["part"]
        key = _key(members[0])
        counting, aim = (
            ("held-out views", "success")
            if key == "rate"
            else ("attacks", "the aim reached")
        )
        if key == "strict":
            aim = "the target class reported and the own class not"
        else:
            aim = aim
        return (
            f"{counting} with {aim}{f' ({part})' if part else ''}",
            counting,
            members,
            key,
        )
    others = [look for look in looks if not look["white_box"]] or list(looks)
    key = next(kind for kind in KINDS if kind in others[0])
    return (
        f"{_JUDGES[others[0]['white_box']]}: {KINDS[key].lower()}",
        "looks",
        others,
        key,
    )


def _key(group: Record) -> str:
    """What a group has reached: a rate of the views of a region, or of its attacks."""
    if "rate" in group:
        return "rate"
    if "found" in group:
        return "strict"
    return "success"


def _noise(line: Record, key: str) -> Record:
    """The control of a rate of a group or of looks."""
    if key == "success":
        return {"successes": line["noise_successes"], "total": line["noise_draws"]}
    nothing = {"successes": 0, "total": 0}
    control: Record = (
        line["controls"].get(NOISE, {}).get(key, nothing)
        if key == "strict"
        else line[f"noise_{key}"]
    )
    return control


def _study_figures(record: Record) -> Iterator[Figure]:
    """Further figures: every aim of the attacks, and who else is deceived."""
    groups = record["groups"]
    looks = record["looks"]
    if groups:
        reached = [
            attack["success"]
            for attack in record["attacks"].values()
            if "success" in attack
        ]
        if "found" not in groups[0]:
            yield Figure(
                label="attacks with the aim reached",
                rate=Rate(successes=sum(reached), total=len(reached)),
            )
        strict = "strict_rate" if "rate" in groups[0] else "strict"
        yield Figure(
            label="with the object's own class gone, too",
            rate=pooled(group[strict] for group in groups),
        )
    for white_box, judges in _JUDGES.items():
        for kind, meaning in KINDS.items():
            for key, what in (
                (kind, meaning.lower()),
                (f"noise_{kind}", f"{meaning.lower()}, with noise alone"),
            ):
                rates = [
                    look[key]
                    for look in looks
                    if look["white_box"] is white_box and key in look
                ]
                if rates:
                    yield Figure(label=f"{judges}: {what}", rate=pooled(rates))


def _warnings(attacks: Sequence[Record]) -> Iterator[str]:
    """The warnings of the attacks; of those that differ in a number alone, the most
    frequent.
    """
    kinds: dict[str, Counter[str]] = {}
    for text in (text for attack in attacks for text in attack.get("warnings", ())):
        kinds.setdefault(_NUMBER.sub("", text), Counter())[text] += 1
    for texts in kinds.values():
        example = "for instance, " if len(texts) > 1 else ""
        yield (
            f"{texts.total()} of {counted(len(attacks), 'attack')}:"
            f" {example}{texts.most_common(1)[0][0]}"
        )


def _doubts(looks: Sequence[Record]) -> Iterator[str]:
    """Judges that do not see the clean object, and figures that noise reaches, so that
    they say nothing.
    """
    others = [look for look in looks if not look["white_box"] and "untargeted" in look]
    gone, noise = (
        pooled(look[key] for look in others)
        for key in ("untargeted", "noise_untargeted")
    )
    if gone.successes and noise.total and noise.fraction >= gone.fraction:
        yield (
            "to detectors that were not attacked, random noise hides the object as"
            f" often ({noise.counts}) as the attacks do ({gone.counts})"
        )
    for look in looks:
        seen = Rate.of(look["found"])
        if seen.fraction < 0.5:
            yield (
                f"{look['detector']} finds the clean object in {seen.words} of its"
                f" looks only ({_labels(look)})"
            )


def _labels(look: Record) -> str:
    return ", ".join(
        [
            *(f"{title_of(axis)} {label}" for axis, label in look["labels"].items()),
            str(look["condition"]),
        ]
    )


def _charts(record: Record) -> Iterator[Chart]:
    """The success of every line of a table, with noise beside it."""
    for title, groups in by_part(record["groups"]).items():
        key = _key(groups[0])
        ticks = tuple(map(str, range(1, len(groups) + 1)))
        below = "line of the table"
        what = "views with success" if key == "rate" else "attacks with the aim reached"
        compared = by_attack(groups)
        if compared:
            groups = [together(of_one) for of_one in compared.values()]
            ticks = tuple(compared)
            below = "attack"
        attacked = Line.of("attack", "attack", [group[key] for group in groups])
        noise = Line.of(
            "random noise", "control", [_noise(group, key) for group in groups]
        )
        yield Chart.bars(title or "The attacks", (below, what), ticks, attacked, noise)
