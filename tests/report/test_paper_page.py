"""The figures of docs/paper.md are what the raw rows of docs/artifacts give."""

import re
from functools import cache

import polars as pl
import pytest

from attacks.figures.frame import AXIS, Figures
from attacks.figures.rate import Rate, pooled
from attacks.figures.result import Result, read_result
from attacks.observe.rows import ATTACKED, CLEAN, ROWS
from attacks.studies.result import SETTING
from tests.project.documented_commands import ROOT

pytestmark = pytest.mark.shipped

DOCS = ROOT / "docs"
FRACTION = re.compile(r"(?<![\w/.])(\d+/\d+)(?![\w/]|\.\d)")
OUR = ("fasterrcnn_small", "yolov8n_small")
TRIGGER = 38.2
PAIR = f"{AXIS}pair"
EPS = f"{AXIS}attack.eps"
OF_THE_PAPER = {"78/80", "80/110"}
LARGEST = {  # by the first words of a part of the study: its largest radius, the page
    "The same in linf": ("0.1", "SH, 0.1: {}"),
    "Means only": ("0.03", "means (0.03 m) {}"),
    "Scales only": ("0.7", "scales {}"),
    "Rotations only": ("0.3", "rotations {}"),
    "Opacities only": ("3", "opacities {}"),
}


@cache
def text() -> str:
    return (DOCS / "paper.md").read_text()


@cache
def result_of(name: str) -> Result:
    return read_result(DOCS / "artifacts" / name)


def percents(rate: Rate) -> str:
    low, high = (f"{100 * end:.1f}" for end in rate.interval)
    return f"{low} to {high} %"


def counted(part: pl.DataFrame) -> Rate:
    return Rate(successes=int(part["found"].sum()), total=len(part))


def of_elevations(detector: str) -> tuple[Rate, Rate, Rate]:
    """The cloaked car detected where the clean one is: near the ground without the
    sector of the stop sign, with it, and from 30 degrees to the edge of the trigger.
    """
    found = (pl.col("original_score") >= 0.5).fill_null(value=False)
    rows = result_of("cloak_car_stealthy").tables[ROWS].with_columns(found=found)
    rows = rows.filter(pl.col("detector") == detector)
    clean = rows.filter("found", splat=CLEAN).select("seed", "view")
    cloaked = rows.filter(splat=ATTACKED).join(clean, on=["seed", "view"])
    elevation = pl.col("elevation")
    near = cloaked.filter(elevation < 20)
    diagonal = cloaked.filter(elevation >= 30, elevation < TRIGGER)
    aside = pl.col("depth: rear") < 0
    return (
        counted(near.filter(aside)),
        counted(near),
        counted(diagonal.filter(aside)),
    )


def of_dagger(start: str) -> Figures:
    """A part of the study with the paper's own search."""
    figures = result_of("dagger").figures.where(scope=SETTING)
    (found,) = (
        part
        for (name,), part in figures.groups("part").items()
        if name.startswith(start)
    )
    return found


def test_cloak_near_the_ground_and_from_diagonal_views() -> None:
    for detector in OUR:
        ground, around, diagonal = of_elevations(detector)
        for rate in (ground, diagonal):
            assert f"{rate.short()} ({percents(rate)}, W) by `{detector}`" in text()
        assert around.short() in text()


def test_cloak_inside_and_outside_of_its_trigger() -> None:
    figures = result_of("cloak_car_stealthy").figures
    for measure in ("trigger_miss_rate_all", "trigger_miss_rate", "benign_recall"):
        rate = figures.rate(measure, detector="yolov8n_small")
        share = f"{100 * rate.fraction:.1f} %"
        assert f"{rate.short()} = {share} ({percents(rate)})" in text()
    for detector in OUR:
        rate = figures.rate("target_rate", detector=detector)
        assert f"{rate.short()} ({percents(rate)}) by `{detector}`" in text()
    three = result_of("cloak_three_appearances").figures
    for trigger in ("overhead", "rear"):
        rate = three.rate("target_rate", detector="fasterrcnn_small", trigger=trigger)
        assert f"{rate.short()} ({percents(rate)})" in text()


def test_confidence_along_the_path() -> None:
    path = result_of("cloak_car_stealthy").tables["path"]
    path = path.filter(pl.col("detector") == "yolov8n_small")
    score = pl.col("original_score").fill_null(0.0)
    up = path.filter(pl.col("view") < 45, splat=ATTACKED).select("elevation", s=score)
    by_elevation = {round(line["elevation"], 1): line["s"] for line in up.to_dicts()}
    assert f"{by_elevation[37.5]:.2f} at 37.5 degrees" in text()
    assert f"{by_elevation[40.0]:.2f} at 40, 0.00 from 42.5 on" in text()
    assert max(up.filter(pl.col("elevation") >= 42.4)["s"]) < 0.005
    assert path.filter(splat=CLEAN).filter(score < 0.4).is_empty()


def test_dagger_with_the_search_of_the_paper() -> None:
    papers = of_dagger("The paper's six pairs").where(**{EPS: "5"})
    pairs = papers.groups(PAIR).values()
    scores = ", ".join(
        f"{100 * (pair.value('score', splat=ATTACKED) or 0.0):.0f}" for pair in pairs
    )
    assert f"by pair: {scores} %" in text()
    rates = [pair.rate("reached", splat=ATTACKED).short() for pair in pairs]
    assert f"{rates[3]}, {rates[4]} and {rates[5]}, but the sign" in text()
    assert rates[:3] == ["3/3"] * 3


def test_dagger_on_each_attribute() -> None:
    row = next(line for line in text().splitlines() if line.startswith("| 17 "))
    for start, (eps, words) in LARGEST.items():
        figures = of_dagger(start).where(**{EPS: eps})
        rate = pooled(figures.rates("reached", splat=ATTACKED))
        assert words.format(rate.short()) in row


def test_median_confidence_of_successes_at_drawn_cameras() -> None:
    rows = result_of("dagger_cameras").tables[ROWS].filter("success", splat=ATTACKED)
    row = next(line for line in text().splitlines() if line.startswith("| 15 "))
    for detector, words in {
        "fasterrcnn_small": "{} % on `fasterrcnn_small`",
        "yolov8n_small": "{} % on `yolov8n_small`",
        "centernet_coco": "{} % on CenterNet",
        "nanodet_coco": "{} % on NanoDet",
    }.items():
        of_one = rows.filter(pl.col("detector") == detector)
        median = of_one.select(pl.col("target_score").median()).item()
        assert words.format(f"{100 * median:.0f}") in row


def test_every_other_fraction_is_of_another_page_or_of_an_artifact() -> None:
    pages = [page for page in DOCS.glob("*.md") if page.name != "paper.md"]
    known = {one for page in pages for one in FRACTION.findall(page.read_text())}
    for detector in OUR:
        known |= {rate.short() for rate in of_elevations(detector)}
    parts = result_of("dagger").figures.where(scope=SETTING).groups("part", EPS)
    for part in parts.values():
        rates = [rate for rate in part.rates("reached", splat=ATTACKED) if rate.total]
        known |= {pooled(rates).short()} if rates else set()
    three = result_of("cloak_three_appearances").figures
    known |= {figure.short() for _, figure in three if isinstance(figure, Rate)}
    assert set(FRACTION.findall(text())) - known - OF_THE_PAPER == set()
