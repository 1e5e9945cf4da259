"""The figures of the documentation are what the raw rows of docs/artifacts give."""

import csv
import json
import re
import runpy
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import polars as pl
import pytest

from attacks import cli
from attacks.figures.frame import AXIS, Figure, Figures, Number, read_figures
from attacks.figures.rate import Rate, pooled
from attacks.figures.result import Result, read_result
from attacks.observe.rows import ATTACKED, CLEAN, NOISE, ROWS, read_rows
from attacks.poisons.base import MANIFEST, footprint_of
from attacks.report.checking import check_result
from attacks.report.results import kind_of, read_section
from attacks.studies.result import (
    ALL_PAIRS,
    BLACK_BOX,
    EVALUATION,
    SETTING,
    SURVIVAL,
    attacks_of,
)
from mi_splat.io.parsing import read_json
from tests.project.documented_commands import ROOT

pytestmark = pytest.mark.shipped

ARTIFACTS = ROOT / "docs" / "artifacts"
OUR = ("fasterrcnn_small", "yolov8n_small")
PAGES: Mapping[str, Any] = runpy.run_path(
    str(ROOT / "docs" / "sphinx_extensions" / "result_tables.py")
)["PAGES"]
FRACTION = re.compile(r"(?<![\w/.])(\d+/\d+)(?![\w/]|\.\d)")
REPORTED_BY_ALL = 0.5
FIGURES = 41_181
RATES = 28_991
"""Of all artifacts."""
MOST_BYTES = 17_000_000
"""Of all artifacts."""


@cache
def result_of(name: str) -> Result:
    return read_result(ARTIFACTS / name)


def test_every_artifact_is_green_and_known_by_its_manifest() -> None:
    """The figures of all, counted: none is lost."""
    page = (ROOT / "docs" / "artifacts.md").read_text()
    figures: list[Figure] = []
    for folder in sorted(ARTIFACTS.iterdir()):
        result = result_of(folder.name)
        assert f"`docs/artifacts/{folder.name}`" in page
        assert result.manifest.sha256 in page
        derive = kind_of(result).derive
        assert derive is not None
        lines = check_result(result, derive)
        assert [(line.name, line.words) for line in lines if line.passed is False] == []
        figures += result.figures.by_key.values()
    rates = sum(isinstance(figure, Rate) for figure in figures)
    assert (len(figures), rates) == (FIGURES, RATES)


def test_artifacts_are_small_and_name_no_machine() -> None:
    files = [path for path in ARTIFACTS.rglob("*") if path.is_file()]
    assert sum(path.stat().st_size for path in files) <= MOST_BYTES
    for path in files:
        if path.suffix in (".json", ".toml"):
            text = path.read_text()
            assert not [
                word for word in ('"/', "/home/", "/tmp/", "/Users/") if word in text
            ]


def fractions(names: Sequence[str]) -> set[str]:
    every = (figure for name in names for _, figure in result_of(name).figures)
    return {figure.short() for figure in every if isinstance(figure, Rate)}


@pytest.mark.parametrize(
    ("page", "part", "names"),
    [
        ("dagger-eot.md", "## Ablations", PAGES["dagger_eot"][2]),
        (
            "cloak.md",
            "## Other cars, objects and viewpoints",
            PAGES["cloak_variations"][2],
        ),
        ("transfer.md", "## Over held-out views", ("transfer_views",)),
        ("audit.md", "**In a study of CLOAK**", ("cloak_robust",)),
    ],
)
def test_fractions_in_tables_by_hand_are_those_of_the_artifacts(
    page: str, part: str, names: Sequence[str]
) -> None:
    text = (ROOT / "docs" / page).read_text()
    text = text.partition(part)[2].partition("\n## ")[0]
    assert set(FRACTION.findall(text)) <= fractions(names)
    assert FRACTION.search(text)


def test_the_transfer_matrix_in_the_guide_is_that_of_the_rows() -> None:
    text = (ROOT / "docs" / "transfer.md").read_text()
    matrix = text.partition("## The matrix")[2].partition("**Method.**")[0]
    cells = re.findall(r"\d+/\d+, \d+/\d+", matrix)
    figures = result_of("transfer").figures.where(scope=EVALUATION)
    lines = figures.groups("detector", "condition", "access", *figures.axes).values()
    assert Counter(cells) == Counter(
        f"{line.rate('targeted').short()}, {line.rate('untargeted').short()}"
        for line in lines
    )


def test_the_tables_of_cloak_are_those_of_the_rows() -> None:
    """Of the three detectors that can judge, and of all five at a confidence of at
    least 0.3.
    """
    result = result_of("cloak_car_stealthy")
    figures = result.figures
    small = result_of("cloak_car_no_shadow").figures
    three = (*OUR, "ssd_openimages")
    cloak = (ROOT / "docs" / "cloak.md").read_text()
    coco = cloak.partition("## Detectors trained on photographs")[2]
    for measure in (
        "trigger_miss_rate",
        "trigger_miss_rate_all",
        "nothing_reported",
        "benign_recall",
    ):
        for detector in three:
            rate = figures.rate(measure, detector=detector)
            assert f"{rate.short()} = {100 * rate.fraction:.1f} %" in cloak
    least, recalls = (
        sorted(100 * small.rate(measure, detector=name).fraction for name in three)
        for measure in ("trigger_miss_rate", "benign_recall")
    )
    assert least[0] == 100 or "from every camera well inside, and" not in cloak
    assert f"elsewhere from {recalls[0]:.1f} to {recalls[-1]:.1f} %" in cloak
    for detector in OUR:
        for of_study in (small, figures):
            assert of_study.rate("target_rate", detector=detector).short() in cloak
    cases = f"{second_car()} cases"
    assert cases in cloak
    for measure in ("surroundings_psnr", "intended_surroundings_psnr"):
        assert f"{figures.value(measure, splat=ATTACKED):.1f}" in cloak
    for name in ("cloak_car_stealthy", "cloak_car_no_shadow"):
        manifest = read_json(ARTIFACTS / name / MANIFEST)
        changed, count, pixels = footprint_of(manifest)
        assert f"{changed} of {count}" in cloak
        assert f"{100 * pixels:.1f} %" in cloak
    rows = result.tables[ROWS].with_columns(found=pl.col("original_score") >= 0.3)
    inside = pl.col("depth: overhead") >= 0
    behind = pl.col("depth: rear") >= 0
    for (detector,), of_one in rows.group_by("detector"):
        hidden = of_one.filter(inside)
        shown = of_one.filter(~inside, ~behind)
        missing = [
            f"{len(part) - part['found'].sum()}/{len(part)}"
            for part in by_splat(hidden)
        ]
        found = [f"{part['found'].sum()}/{len(part)}" for part in by_splat(shown)]
        assert f"| `{detector}` | {' | '.join((*missing, *found))} |" in coco
    for low, high in ((0, 20), (20, 40), (40, 60), (60, 90)):
        band = rows.filter(
            pl.col("elevation").is_between(low, high, closed="left"), ~behind
        )
        bands = [
            by_splat(band.filter(detector=name))
            for name in ("centernet_coco", "nanodet_coco", "ssd_openimages")
        ]
        cells = [
            ", ".join(f"{part['found'].sum()}/{len(part)}" for part in parts)
            for parts in bands
        ]
        assert f"| {low} to {high} | {' | '.join(cells)} |" in coco


def second_car() -> str:
    """How often a second car is missed well inside the trigger, by all detectors that
    can judge.
    """
    second = result_of("cloak_second_car").figures
    ((_, figures),) = second.having("setting").groups("part", "setting").items()
    rates = (
        figures.rate("trigger_miss_rate", detector=name)
        for name in (*OUR, "ssd_openimages")
    )
    return pooled(rates).short()


def test_the_attack_on_a_detector_and_a_reader_is_counted() -> None:
    text = (ROOT / "docs" / "detectors.md").read_text()
    every = read_rows(ROOT / "docs" / "tables" / "attack_reader.csv.xz")
    rows = every.filter(detector="yolov8n_small and rapidocr")
    reached = {
        target: rows.filter(splat=ATTACKED, target=target)["success"]
        for target in ("tv", "train", "bird")
    }
    noise = rows.filter(splat=NOISE)["success"]
    for cell in (*reached.values(), noise):
        assert f"{cell.sum()}/{len(cell)}" in text
    assert not noise.any()
    other = every.filter(sources="fasterrcnn_small")
    for splat, count in ((ATTACKED, "{}"), (NOISE, "with noise {}")):
        here = other.filter(splat=splat)
        for name in ("rapidocr", "fasterrcnn_small and rapidocr"):
            seen = here.filter(detector=name)["success"]
            assert count.format(f"{seen.sum()}/{len(seen)}") in text


def test_the_table_of_third_party_detectors_is_that_of_the_rows() -> None:
    """Attacks count whose clean object is detected; a judge's report is compared as far
    as it knows the class.
    """
    text = (ROOT / "docs" / "detectors.md").read_text()
    report = pl.when(pl.col("score") >= REPORTED_BY_ALL).then("label")
    rows = result_of("third_party_detectors").tables[ROWS].with_columns(report=report)
    own = rows.filter(pl.col("detector") == pl.col("sources"))
    name = (
        pl.when(pl.col("target").is_in(["tv", "train", "bird"]))
        .then(pl.lit("stop sign"))
        .otherwise(pl.lit("car"))
    )
    own = own.with_columns(object=name)
    seen = own.filter(pl.col("report") == pl.col("object"), splat=CLEAN).select(
        "attack"
    )
    for judge, known in (("rapidocr", "stop sign"), ("ssdlite_pedestrian", "person")):
        said = rows.filter(detector=judge).select(
            "attack", "splat", "view", verdict="report"
        )
        both = own.join(seen, on="attack", how="semi").join(
            said, on=("attack", "splat", "view")
        )
        common = pl.when(pl.col("report") == known).then("report")
        both = both.with_columns(flag=common.ne_missing(pl.col("verdict")))
        for splat in (CLEAN, NOISE):
            quiet = both.filter(splat=splat)
            assert f"({quiet['flag'].sum()}/{len(quiet)} each, for both)" in text
            assert not quiet["success"].any()
        for (target, what), part in both.group_by("target", "object"):
            if (judge == "rapidocr") == (target == "person"):
                continue
            attacked = part.filter(splat=ATTACKED)
            wins = [
                of["success"]
                for of in (attacked.filter(sources=source) for source in OUR)
            ]
            judged = [
                part.filter(splat=splat)["verdict"]
                for splat in (CLEAN, NOISE, ATTACKED)
            ]
            flags = attacked.filter("success")["flag"]
            cells = [
                ", ".join(f"{won.sum()}/{len(won)}" for won in wins),
                f"`{judge}`",
                ", ".join(
                    f"{len(cell) - cell.null_count()}/{len(cell)}" for cell in judged
                ),
                f"{flags.sum()}/{len(flags)}",
            ]
            line = (
                f"| {'sign' if what == 'stop sign' else 'car'} to {target} |"
                f" {' | '.join(cells)} |"
            )
            assert line in text or (
                judge == "ssdlite_pedestrian" and target != "person"
            ), line


def by_splat(rows: pl.DataFrame) -> tuple[pl.DataFrame, pl.DataFrame]:
    return rows.filter(splat=CLEAN), rows.filter(splat=ATTACKED)


# The figures of README


PAPERS_SEARCH = "The paper's own search"
DETECTORS = f"{AXIS}detectors"
PAIR = f"{AXIS}pair"
EPS = f"{AXIS}attack.eps"


def drawn(scope: str, *, papers: bool = False) -> Figures:
    """What attacks from drawn cameras have reached with the usual radius."""
    figures = result_of("dagger_cameras").figures.where(scope=scope, **{EPS: None})
    parts = figures.groups("part")
    return Figures.together(
        of_part
        for (part,), of_part in parts.items()
        if (part == PAPERS_SEARCH) == papers
    )


def from_one_view(detector: str, *, papers: bool = False) -> Figures:
    """The same on a detector, for all pairs together."""
    return drawn(ALL_PAIRS, papers=papers).where(**{DETECTORS: detector})


def strict(figures: Figures, splat: str = ATTACKED) -> Rate:
    return figures.rate("strict_if_detected", splat=splat)


def decibels(figures: Figures, splat: str = ATTACKED) -> float:
    psnr = figures.value("psnr_object_if_detected", splat=splat)
    assert psnr is not None
    return psnr


def test_the_table_of_drawn_cameras_is_counted_from_its_rows() -> None:
    text = (ROOT / "docs" / "dagger.md").read_text()
    for name in ("yolov8n_small", "nanodet_coco", "centernet_coco", "fasterrcnn_small"):
        line = from_one_view(name)
        pairs = drawn(SETTING).where(**{DETECTORS: name}).groups(PAIR).values()
        cells = [strict(of_pair).short() for of_pair in pairs]
        cells += [
            strict(line).short(interval=True),
            line.rate("success_if_detected", splat=ATTACKED).short(),
            strict(line, NOISE).short(),
            line.rate("lost_if_detected", splat=NOISE).short(),
            f"{decibels(line):.1f}, {decibels(line, NOISE):.1f}",
        ]
        assert f"| `{name}` | {' | '.join(cells)} |" in text
    random = result_of("dagger_cameras_random").figures.where(scope=ALL_PAIRS)
    ((_, line),) = random.groups("part", *random.axes).items()
    reached = f"{strict(line).counts} on `yolov8n_small`"
    assert f"({reached}, object PSNR {decibels(line):.1f} dB)" in text
    for name in ("yolov8n_small", "fasterrcnn_small"):
        line = from_one_view(name, papers=True)
        assert strict(line).short() in text
        assert line.rate("success_if_detected", splat=ATTACKED).short() in text
    together = result_of("dagger_cameras").figures.where(scope=ALL_PAIRS)
    radii = together.having(EPS).groups("part", *together.axes)
    assert set(together.labels(EPS)) == {"3", "6", "7", "10"}
    for line in (*radii.values(), from_one_view("fasterrcnn_small")):
        assert f"{100 * strict(line).fraction:.0f} %" in text
        assert f"{decibels(line):.1f}" in text


def test_the_cost_in_image_quality_is_that_of_the_search_it_is_said_of() -> None:
    text = (ROOT / "docs" / "dagger.md").read_text()
    detectors = (*OUR, "nanodet_coco", "centernet_coco")
    costs = [sorted(decibels(from_one_view(name)) for name in detectors)]
    figures = result_of("dagger").figures.where(scope=SETTING)
    (papers,) = (
        of_part
        for (part,), of_part in figures.groups("part").items()
        if part.startswith("The paper's six")
    )
    for measure in ("psnr_object", "image_psnr"):
        values = [
            number.value
            for _, number in papers.where(measure=measure)
            if isinstance(number, Number)
        ]
        assert len(values) == 6
        costs.append(sorted(values))
    for values in costs:
        assert f"{values[0]:.1f} to {values[-1]:.1f} dB" in text


@pytest.mark.nightly
@pytest.mark.parametrize("number", [0, 40, 200])
def test_the_row_of_one_view_is_what_the_command_does(
    number: int,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """With the ball of the study and its other defaults, from one of the drawn cameras:
    the same verdict, and an image that is as far away.
    """
    monkeypatch.chdir(ROOT)
    result = result_of("dagger_cameras")
    attacks = [
        (name, attack)
        for name, attack in attacks_of(result.record).items()
        if attack.part == "Untuned detectors, three seeds"
        and attack.sources == ["yolov8n_small"]
    ]
    name, attack = attacks[number]
    settings = attack.settings
    cameras = json.loads(Path(settings["cameras"]).read_text())["cameras"]
    view = f"{settings['cameras']}#{cameras[settings['camera']]['name']}"
    words = [
        "dagger",
        settings["scene"],
        "--object",
        settings["object"],
        "--target",
        settings["objective"]["label"],
    ]
    words += [
        "--detectors",
        *settings["detectors"],
        "--cameras",
        view,
        "--eps",
        str(settings["attack"]["eps"][0]),
        "--seed",
        str(attack.stated["seed"]),
        "--random-start",
    ]
    assert (
        cli.main(
            [*words, "--noise-draws", "1", "--out", str(tmp_path / "out"), "--json"]
        )
        == 0
    )
    done = json.loads(capsys.readouterr().out)
    reached = read_figures(tmp_path / "out")
    for measure in ("reached", "reached_strictly"):
        expected = result.figures.rate(measure, attack=name, splat=ATTACKED)
        assert reached.rate(measure, splat=ATTACKED) == expected
    assert done["image_psnr"] == pytest.approx(attack.stated["image_psnr"], abs=0.3)


def from_a_region(detector: str) -> list[Figures]:
    """The attacks on a detector from all cameras of a region, pair by pair."""
    figures = result_of("dagger_eot_pairs").figures.where(scope=SETTING)
    pairs = figures.groups("part", PAIR).items()
    return [of for (part, _), of in pairs if part.partition(",")[0] == detector]


def summed(lines: Iterable[Figures], measure: str, splat: str = ATTACKED) -> str:
    return pooled(line.rate(measure, splat=splat) for line in lines).short()


def test_the_table_of_a_region_is_counted_from_its_rows() -> None:
    text = (ROOT / "docs" / "dagger-eot.md").read_text()
    for name in ("nanodet_coco", "yolov8n_small", "fasterrcnn_small"):
        pairs = from_a_region(name)
        objects = [
            sorted(decibels(pair, splat) for pair in pairs)
            for splat in (ATTACKED, NOISE)
        ]
        cells = [
            *(strict(pair).short() for pair in pairs),
            summed(pairs, "strict_if_detected"),
            summed(pairs, "strict"),
            summed(pairs, "strict_if_detected", NOISE),
            summed(pairs, "lost_if_detected", NOISE),
            "; ".join(f"{of[0]:.1f} to {of[-1]:.1f}" for of in objects),
        ]
        assert f"| `{name}` | {' | '.join(cells)} |" in text
    (other,) = from_a_region("ssd_openimages")
    assert strict(other).short() in text


def untuned(name: str, detector: str, measure: str) -> str:
    """A rate of a study of CLOAK over all seeds but the one on which settings were
    chosen.
    """
    figures = result_of(name).figures
    seeds = [seed for seed in figures.labels("seed") if seed != 0]
    return pooled(
        figures.rate(measure, seed=seed, detector=detector) for seed in seeds
    ).short()


def transferred() -> str:
    figures = result_of("transfer").figures
    others = figures.where(scope=EVALUATION, access=BLACK_BOX).groups(DETECTORS)
    return pooled(
        rate
        for (attacked,), of_attack in others.items()
        if " + " not in attacked
        for rate in of_attack.rates("targeted")
    ).short()


def transferred_from_many() -> str:
    figures = result_of("transfer_views").figures.where(scope=EVALUATION)
    rates = [
        of_one.pooled("targeted").short()
        for (name,), of_one in figures.groups("detector").items()
        if name != "fasterrcnn_small"
    ]
    return f"{', '.join(rates[:-1])} and {rates[-1]} views of three other detectors"


def grown(part: str, value: str) -> tuple[str, str]:
    """How many times the Gaussians of a clean splat poisoned ones have, over the seeds
    on which nothing was chosen.
    """
    counts: dict[int, dict[str, int]] = {}
    for victim in result_of("poison_splat").record["victims"]:
        if (
            (victim["part"], victim["value"]) == (part, value)
            and victim["seed"]
            and not victim["defended"]
        ):
            counts.setdefault(victim["seed"], {})[victim["splat"]] = victim["gaussians"]
    pairs = [(splats["attacked"], splats["clean"]) for splats in counts.values()]
    mean = sum(attacked / clean for attacked, clean in pairs) / len(pairs)
    return f"{mean:.1f} times", " and ".join(
        f"{attacked:,}/{clean:,}" for attacked, clean in pairs
    )


CAPTURES = ("banana", "doll", "fox", "plant")
"""Captures on which no setting of the search was chosen."""
BUDGETS = ("34", "38")
"""PSNR of the object, dB."""
BUDGET = f"{AXIS}attack.object_psnr"
PHOTOGRAPHS = ("nanodet_coco", "centernet_coco", "ssd_openimages")


def on_captures(names: Sequence[str], budget: str, splat: str = ATTACKED) -> Rate:
    """DAGGER's strict successes on captures within one budget, all detectors
    together.
    """
    figures = result_of("dagger_captures").figures.where(scope=SETTING)
    lines = [
        line
        for name in names
        for (psnr, _), line in figures.where(part=name)
        .groups(BUDGET, DETECTORS)
        .items()
        if psnr == budget
    ]
    rates = [line.rate("strict_if_detected", splat=splat) for line in lines]
    return pooled(rate for rate in rates if rate.total)


def front_row() -> str:
    """CLOAK on the front of a photographed car, three training seeds together."""
    seeds = [result_of(f"cloak_photographs_{seed}").figures for seed in (1, 2, 3)]
    hidden = {
        pooled(
            of_seed.rate("missed", scope="inside", detector=name, split="test")
            for of_seed in seeds
        ).short()
        for name in PHOTOGRAPHS
    }
    (missed,) = hidden  # the same for each detector
    elsewhere = pooled(
        of_seed.where(split=None).rate(
            "detected", scope="elsewhere", detector=PHOTOGRAPHS[2]
        )
        for of_seed in seeds
    ).short()
    return (
        f"a car in a street missed from {missed} held-out cameras in front of it by"
        " each of NanoDet, CenterNet and SSD; SSD detects it elsewhere in"
        f" {elsewhere}"
    )


def narrow(measure: str, splat: str = ATTACKED) -> str:
    """DAGGER around a camera at 38 dB, on the captures that nothing was chosen on."""
    figures = result_of("dagger_narrow").figures.where(scope=SETTING)
    parts = [figures.where(part=name) for name in CAPTURES]
    rates = [rate for part in parts for rate in part.where(splat=splat).rates(measure)]
    return pooled(rate for rate in rates if rate.total).short()


def test_pages_say_what_the_rows_give_of_captures_and_of_transfer() -> None:
    captures = (ROOT / "docs" / "real-captures.md").read_text()
    for budget in BUDGETS:
        assert on_captures(CAPTURES, budget).short() in captures
    for rate in FRACTION.findall(front_row()):
        assert rate in captures
    transfer = (ROOT / "docs" / "transfer.md").read_text()
    assert transferred() in (ROOT / "docs" / "dagger.md").read_text()
    for rate in FRACTION.findall(transferred_from_many()):
        assert rate in transfer


CONDITIONS = {
    "JPEG 90": "JPEG 90",
    "JPEG 75": "JPEG 75",
    "JPEG 50": "JPEG 50",
    "half the size": "0.5 x size",
    "double size": "2 x size",
    "`.splat`": ".splat",
    "SH cut to degree 0": "SH of degree 0",
    "`ray`": "ray",
}
"""Conditions of both attacks, by what the page on defences calls them."""


def test_the_table_of_what_survives_is_counted_from_its_rows() -> None:
    text = (ROOT / "docs" / "defences.md").read_text()
    one, many = (
        result_of(name).figures.where(scope=SURVIVAL)
        for name in ("dagger_one_view", "dagger_narrow")
    )
    columns = [
        (one, "fox"),
        (one, "doll"),
        (many, "fox"),
        (many, "doll"),
        (many, "banana"),
        (many, "banana, 35 dB"),
    ]
    for words, condition in CONDITIONS.items():
        under = [of.where(part=part, condition=condition) for of, part in columns]
        measure = "strict_if_detected"
        attacked = [part.pooled(measure, splat=ATTACKED) for part in under]
        noise = pooled(part.pooled(measure, splat=NOISE) for part in under)
        cells = [rate.short() if rate.total else "" for rate in (*attacked, noise)]
        line = next(line for line in text.splitlines() if line.startswith(f"| {words}"))
        assert [cell.strip() for cell in line.split("|")[2:-1]] == cells


def contradicted(table: str = "audit_third") -> tuple[str, str]:
    """How many files are contradicted of those that hide something, and of honest
    ones; weak poisonings and attackers who know the audit count on neither side.
    """
    with (ROOT / "docs" / "tables" / f"{table}.csv").open() as file:
        every = list(csv.DictReader(file))
    counts = []
    for kind in ("hidden", "honest"):
        rows = [
            row
            for row in every
            if row["file"].startswith(kind) and float(row["strength"] or 1) >= 0.4
        ]
        found = sum(row["answer"] == "contradicted" for row in rows)
        counts.append(f"{found}/{len(rows)}")
    hidden, honest = counts
    return hidden, honest


def test_the_page_on_the_audit_says_what_held_out_directions_give() -> None:
    text = (ROOT / "docs" / "audit.md").read_text()
    hidden, honest = contradicted()
    assert f"contradicts {hidden} of the files that hide something" in text
    assert f"and {honest} of the honest ones" in text
    sets = (
        ("audit_third", "third"),
        ("audit_second", "second"),
        ("audit_held_out", "first"),
    )
    for table, name in sets:
        hidden, honest = contradicted(table)
        assert f"| {name} | {hidden} | {honest} |" in text
    hidden, honest = contradicted("audit_third_shipped")
    assert f"with what ships alone, {hidden} are contradicted, and {honest}" in text
    _, honest = contradicted("audit_meshes")
    assert honest.partition("/")[0] == "0"
    assert f"{honest.partition('/')[2]} meshes of two packages" in text


def test_the_page_on_the_audit_says_how_strong_and_wide_a_change_has_to_be() -> None:
    text = (ROOT / "docs" / "audit.md").read_text()
    with (ROOT / "docs" / "tables" / "audit_strength.csv").open() as file:
        rows = list(csv.DictReader(file))
    for kind in ("amount", "width"):
        for name in ("car", "house", "person"):
            found = [
                f"{float(row['evidence']):.2f}"
                for row in rows
                if kind in row["file"] and row["file"].endswith(f"/{name}")
            ]
            assert f"| {name} | {' | '.join(found)} |" in text


def test_the_page_on_the_audit_says_what_an_attack_on_it_costs() -> None:
    text = (ROOT / "docs" / "audit.md").read_text()
    with (ROOT / "docs" / "tables" / "audit_attack.csv").open() as file:
        rows = list(csv.DictReader(file))
    for weight in sorted({row["weight"] for row in rows}):
        under = [row for row in rows if row["weight"] == weight]
        cells = [under[0]["answer"]]
        for row in under:
            cells.append(f"{row['inside']}/{row['of_inside']}")
            cells.append(f"{row['elsewhere']}/{row['of_elsewhere']}")
        assert f"| {weight} | {' | '.join(cells)} |" in text


def test_the_page_on_the_audit_says_what_a_repair_brings_back() -> None:
    text = (ROOT / "docs" / "audit.md").read_text()
    with (ROOT / "docs" / "tables" / "audit_repair.csv").open() as file:
        rows = list(csv.DictReader(file))
    shown = {
        "CLOAK in the file": "car, by CLOAK in the file",
        "hidden above, trained/train 2004": "train, trained",
        "hidden above, trained/suitcase 2016": "suitcase, trained",
    }
    for name, label in shown.items():
        for splat in ("clean", "attacked", "repaired"):
            cells = []
            for row in rows:
                if row["file"] == name and row["splat"] == splat:
                    cells.append(f"{row['inside']}/{row['of_inside']}")
                    cells.append(f"{row['elsewhere']}/{row['of_elsewhere']}")
            assert f"| {label}: {splat} | {' | '.join(cells)} |" in text


def test_the_page_on_the_audit_says_what_a_repair_brings_back_of_studies() -> None:
    text = (ROOT / "docs" / "audit.md").read_text()
    with (ROOT / "docs" / "tables" / "audit_repair_studies.csv").open() as file:
        rows = list(csv.DictReader(file))
    names = {
        ("cloak_demo", "0"): "poison",
        ("cloak_demo", "1"): "poison, seed 1",
        ("cloak_demo_layers", "0"): "layers",
    }
    assert names.keys() == {(row["study"], row["seed"]) for row in rows}
    for name, label in names.items():
        for splat in ("clean", "attacked", "repaired"):
            of_splat = [
                row
                for row in rows
                if (row["study"], row["seed"]) == name and row["splat"] == splat
            ]
            wheres = sorted({row["where"] for row in of_splat} - {"elsewhere"})
            assert wheres, (name, splat)
            for where in wheres:
                cells = [
                    f"{row['found']}/{row['cameras']}"
                    for row in of_splat
                    if row["where"] in (where, "elsewhere")
                ]
                # by detector, and of each inside before elsewhere
                order = [cells[1], cells[0], cells[3], cells[2]]
                line = f"| {label}, {where}: {splat} | {' | '.join(order)} |"
                assert line in text


def readme_rows() -> list[tuple[str, str, str]]:
    """Of each attack, and of the audit: its name, its rate and its control."""
    on_photographs = front_row().partition("missed from ")[2].partition(" ")[0]
    yolo = OUR[1]
    stealthy = "cloak_car_stealthy"
    layers = "cloak_car_layers"
    times, _ = grown("eps", "16")
    noise_times, _ = grown("controls", "uniform noise of 16")
    nano = from_a_region("nanodet_coco")
    found, alarms = contradicted()
    return [
        (
            "DAGGER, one view",
            on_captures(CAPTURES, BUDGETS[1]).short(),
            on_captures(CAPTURES, BUDGETS[1], NOISE).short(),
        ),
        (
            "DAGGER, around a camera",
            narrow("strict_if_detected"),
            narrow("strict_if_detected", NOISE),
        ),
        (
            "DAGGER, all around",
            summed(nano, "strict_if_detected"),
            summed(nano, "strict_if_detected", NOISE),
        ),
        ("CLOAK, photographs", on_photographs, on_photographs),
        (
            "CLOAK, path-traced images",
            untuned(stealthy, yolo, "trigger_miss_rate"),
            untuned(stealthy, yolo, "control_recall"),
        ),
        (
            "CLOAK in the file",
            untuned(layers, yolo, "trigger_miss_rate"),
            untuned(layers, yolo, "control_recall"),
        ),
        ("Poison-splat", times, noise_times),
        ("audit of a file", found, alarms),
    ]


def test_readme_says_what_the_rows_give() -> None:
    """Every rate of the table of results, with its denominator and its control; the
    last line, of the audit of images, is what its own test asks for.
    """
    text = (ROOT / "README.md").read_text()
    table = text.partition("## Results")[2].partition("DAGGER counts")[0]
    lines = [line for line in table.splitlines() if line.startswith("|")][2:]
    assert "audit of the images" in lines.pop()
    for line, (name, rate, control) in zip(lines, readme_rows(), strict=True):
        cells = [cell.strip() for cell in line.strip("|").split("|")]
        assert name in cells[0]
        assert FRACTION.findall(cells[2]) in ([rate], []), line
        assert FRACTION.findall(cells[3]) in ([control], []), line
        assert rate in cells[2]
        assert control in cells[3]


@pytest.mark.parametrize(
    "result", sorted(ARTIFACTS.glob("*/result.json")), ids=lambda path: path.parent.name
)
def test_every_artifact_has_a_section(result: Path) -> None:
    assert read_section(result.parent).conclusion
