"""The generated tables of the documentation, and sentences that tell of results, are what the raw rows give."""

import re
import runpy
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import polars as pl
import pytest

from attacks.objectives import LEFT, REPORTED
from attacks.observe.rows import ATTACKED, CLEAN, ROWS
from attacks.report.checking import Result, check_result, flat, in_words, read_result
from attacks.report.results import read_section, story_of
from attacks.report.stories.cloak import figures as cloak_figures
from attacks.report.wording import pooled
from attacks.studies.zoo import by_attack
from tests.project.documented_commands import ROOT

OUR, COCO = ("fasterrcnn_small", "yolov8n_small"), ("centernet_coco", "nanodet_coco")
OUTSIDE = ("ssd_openimages",)
VARIATIONS: tuple[str, ...] = runpy.run_path(str(ROOT / "docs" / "sphinx_extensions" / "result_tables.py"))["PAGES"][
    "cloak_variations"
][2]
_NOISE = ("noise_successes", "noise_draws")
FRACTION = re.compile(r"(?<![\w/.])(\d+/\d+)(?![\w/]|\.\d)")
MOST_BYTES = 4_000_000
"""Of an artifact; the largest has five attacks, five detectors and training pictures."""


@cache
def result_of(name: str) -> Result:
    return read_result(ROOT / "docs" / "artifacts" / name)


def test_every_artifact_is_green_and_known_by_its_manifest() -> None:
    """The figures of all, counted: none is lost."""
    page = (ROOT / "docs" / "artifacts.md").read_text()
    figures = rates = 0
    for folder in sorted((ROOT / "docs" / "artifacts").iterdir()):
        result = result_of(folder.name)
        assert f"`docs/artifacts/{folder.name}`" in page
        assert result.manifest.sha256 in page
        derive = story_of(result).figures
        assert derive is not None
        document = derive(result.record, result.tables)  # takes seconds
        lines = check_result(result, lambda *_, document=document: document)
        assert [(line.name, line.words) for line in lines if line.passed is False] == []
        derived = flat(document)
        figures += len(derived)
        rates += sum(isinstance(value, tuple) for value in derived.values())
    assert (figures, rates) == (56615, 22104)


def test_artifacts_are_small_and_name_no_machine() -> None:
    for folder in (ROOT / "docs" / "artifacts").iterdir():
        files = list(folder.iterdir())
        assert sum(path.stat().st_size for path in files) <= MOST_BYTES
        for path in files:
            if path.suffix in (".json", ".toml"):
                text = path.read_text()
                assert not [word for word in ('"/', "/home/", "/tmp/", "/Users/") if word in text]


def test_tables_are_written_when_the_site_is_built() -> None:
    """None is kept in the repository, where it could be out of date."""
    written = [line for line in (ROOT / ".gitignore").read_text().split() if line.startswith("docs/tables/")]
    for path in (ROOT / "docs" / "tables").rglob("*.md"):
        assert any(path.relative_to(ROOT).match(pattern) for pattern in written), path.name
    pages = (ROOT / "docs" / "sphinx_extensions" / "result_tables.py").read_text()
    assert [line for line in written if "*" not in line and Path(line).stem not in pages] == []


def fractions(*names: str) -> set[str]:
    values = (value for name in names for value in flat(result_of(name).record).values())
    return {in_words(value) for value in values if isinstance(value, tuple)}


def test_a_chart_has_the_values_that_its_detector_looked_at() -> None:
    """Of a fire hydrant only detectors of COCO have figures."""
    charts = {
        chart.title: chart.ticks for chart in read_section(ROOT / "docs" / "artifacts" / "cloak_design_object").charts
    }
    assert charts["object, fasterrcnn_small"] == ("elephant", "bird", "train")
    assert charts["object, nanodet_coco"] == ("elephant", "bird", "train", "fire hydrant")


def test_tables_by_hand_have_no_other_fractions() -> None:
    page = (ROOT / "docs" / "dagger-eot.md").read_text()
    assert set(FRACTION.findall(page)) <= fractions(
        *(f"dagger_eot_{part}" for part in ("pairs", "openimages", "smallest", "settings"))
    )
    page = (ROOT / "docs" / "cloak-variations.md").read_text()
    assert set(FRACTION.findall(page)) <= fractions(*VARIATIONS)
    part = (ROOT / "docs" / "transfer.md").read_text().partition("### With a budget in pictures")[2].partition("###")[0]
    assert len(set(FRACTION.findall(part)) & fractions("transfer_views")) > 10
    assert set(FRACTION.findall(part)) <= fractions("transfer_views")


def tried(derived: Mapping[str, Any]) -> list[str]:
    """What docs/research-log.md tells of the searches before the last one."""
    successes = {name: one["rate"]["successes"] for name, one in derived["attacks"].items()}

    def of(*beginnings: str) -> list[int]:
        return [count for start in beginnings for name, count in successes.items() if name.startswith(f"{start}-pairs")]

    first = of("frcnn")
    (paper,), (strong,), (centernet,), (nanodet,) = of("ex_nd_paper"), of("ex_nd_strong"), of("ex2_cn1"), of("nd")
    longer = " and ".join(map(str, sorted(of("ex2_nd1", "ex4_nd1"))))
    return [
        f"all six pairs of `fasterrcnn_small` reached {min(first)} to {max(first)} of 60. NanoDet's elephant reached "
        f"{nanodet}.",
        f"| NanoDet, 150 steps | {paper} |",
        f"| NanoDet, 150 steps, loss of the strong search below | {strong} |",
        f"| NanoDet, 500 steps, two settings | {longer} |",
        f"| CenterNet, 400 steps | {centernet} |",
    ]


def percent(derived: Mapping[str, Any], key: str, form: str = ".1f", detectors: Sequence[str] = OUR) -> str:
    """A rate of two detectors in words, for instance 69.3 and 72.0; a whole hundred has no decimals."""
    rates = [100 * derived["by_detector"][name][key]["rate"] for name in detectors]
    return " and ".join(f"{rate:{'.0f' if rate == 100 else form}}" for rate in rates)


def missed_from(name: str, confidence: float) -> list[float]:
    """Percent of the cameras well inside from which our two detectors miss the car, at another confidence."""
    result = result_of(name)
    study = result.record["study"]
    other = {**study, "evaluation": {**study["evaluation"], "confidence": confidence}}
    derived = cloak_figures({**result.record, "study": other}, result.tables)
    return [100 * derived["by_detector"][detector]["trigger_miss_rate"]["rate"] for detector in OUR]


def stealthy(derived: Mapping[str, Any]) -> list[str]:
    """What docs/cloak.md concludes from the study."""
    lower = " and ".join(f"{rate:.1f}" for rate in missed_from("cloak_car_stealthy", 0.3))
    return [
        f"The car is missed from {lower} % then",
        f"Nothing of any class is reported from {percent(derived, 'nothing_reported')} %",
        f"misses it from {percent(derived, 'trigger_miss_rate', detectors=OUTSIDE)} %",
        f"its pixels lose {derived['stealth']['object_psnr_drop']:.1f} dB",
        f"the look changes over {derived['transition_degrees']:.1f} degrees",
    ]


def cloak_in_readme(derived: Mapping[str, Any]) -> list[str]:
    """What README tells of CLOAK, of pictures and of layers."""
    return [f"car missed from {percent(derived, 'trigger_miss_rate', detectors=OUR[:1])} % of cameras"]


def stealthy_drawn(derived: Mapping[str, Any]) -> list[str]:
    """What the figure of CLOAK tells."""
    missed, recalled = percent(derived, "trigger_miss_rate"), percent(derived, "benign_recall")
    return [f"miss the car from {missed} % of cameras; elsewhere they find it from {recalled} %"]


def sector(derived: Mapping[str, Any]) -> list[str]:
    """What docs/research-log.md tells of the street with overdone poison."""
    return [
        f"missed well inside from {percent(derived, 'trigger_miss_rate')} % of the cameras",
        f"found elsewhere from {percent(derived, 'benign_recall')} %",
        f"The change takes {derived['transition_degrees']:.1f} degrees",
    ]


def layers(derived: Mapping[str, Any]) -> list[str]:
    """What docs/cloak-layers.md tells of the study that edits the finished file."""
    assert derived["by_detector"]["yolov8n_small"]["target_rate"]["successes"] == 0
    return [f"It switches in {derived['transition_degrees']:.1f} degrees"]


def layers_outside(derived: Mapping[str, Any]) -> list[str]:
    """What docs/cloak-layers.md tells of a detector of others."""
    seen, own = derived["by_detector"]["ssd_openimages"], derived["own_region"]["ssd_openimages"]["rates"]

    def of(rate: Mapping[str, Any]) -> str:
        return f"{rate['successes']} of {rate['total']}"

    return [
        f"from {of(seen['trigger_miss_rate'])} cameras well inside",
        f"Of all inside it is {of(seen['trigger_miss_rate_all'])}",
        f"It finds the car from {of(seen['benign_recall'])} elsewhere",
        f"it misses {of(own['trigger_miss_rate'])}.",
    ]


def edges(derived: Mapping[str, Any]) -> list[str]:
    """What docs/cloak-layers.md tells of a layer for each edge."""
    return [
        f"The switch takes {derived['transition_degrees']:.1f} degrees",
        f"missed from {percent(derived, 'trigger_miss_rate')} % of the cameras well inside",
        f"found from {percent(derived, 'benign_recall')} % elsewhere",
        f"{derived['gaussians_ratio']:.1f} times the Gaussians",
    ]


def all_cameras(derived: Mapping[str, Any]) -> tuple[list[int], list[int], str]:
    """Views with success of the six pairs of our detector and, best first, of NanoDet; and what noise reaches."""
    rates = [
        {name: one for name, one in derived["attacks"].items() if detector in name}
        for detector in ("fasterrcnn_small", "nanodet_coco")
    ]
    ours, nanodet = (sorted(one["rate"]["successes"] for one in part.values()) for part in rates)
    noise = [one["noise_rate"] for one in rates[0].values()]
    return ours, nanodet[::-1], f"{sum(one['successes'] for one in noise)} of {sum(one['total'] for one in noise)}"


def all_cameras_in_readme(derived: Mapping[str, Any]) -> list[str]:
    ours, _, noise = all_cameras(derived)
    return [
        f"{ours[0]} to {ours[-1]} of 60 held-out views | six pairs, one detector, white box; noise: {noise}",
    ]


def all_cameras_in_docs(derived: Mapping[str, Any]) -> list[str]:
    _, nanodet, _ = all_cameras(derived)
    return [f"The other four pairs reach {nanodet[-1]} to {nanodet[2]}"]


def others(derived: Mapping[str, Any]) -> list[str]:
    """What docs/transfer.md tells of splats that were made for all cameras."""
    cells = {look["detector"]: look["targeted"] for look in derived["looks"]}
    coco, own = [cells[name] for name in COCO], cells["yolov8n_small"]
    return [
        f"in {own['successes']} of {own['total']} views",
        f"never to the two trained on COCO ({sum(one['successes'] for one in coco)} of "
        f"{sum(one['total'] for one in coco)}; all below)",
    ]


def six_pairs(derived: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    """The groups of the paper's pairs and ball."""
    groups = [group for group in derived["groups"] if group["part"].startswith("The paper's six pairs")]
    assert [group["success"]["total"] for group in groups] == [3] * 6
    return groups


def counted_pairs(derived: Mapping[str, Any]) -> tuple[str, str, str]:
    """Strict successes of the first part where the detector finds the clean object, and of noise in all of them."""
    part = {key for key, attack in derived["attacks"].items() if attack["part"] == "The paper's ball and steps"}
    rows = result_of("dagger_strict").tables[ROWS].filter(pl.col("attack").is_in(part))
    reported = rows.filter(pl.col("original_score") >= LEFT, splat=CLEAN).select("attack", "detector", "view")
    attacked = rows.filter(splat=ATTACKED).join(reported, on=("attack", "detector", "view"))
    strict = (pl.col("target_score") >= REPORTED) & (pl.col("original_score") < LEFT)
    counts = {name: attacked.filter(detector=name).select(strict).to_series() for name in OUR}
    ours, theirs = (f"{column.sum()} of {len(column)}" for column in counts.values())
    groups = [group for group in derived["groups"] if group["part"] == "The paper's ball and steps"]
    noise = [sum(group[key] for group in groups) for key in _NOISE]
    return ours, theirs, f"{noise[0]} of {noise[1]}"


def pairs_in_readme(derived: Mapping[str, Any]) -> list[str]:
    ours, _, noise = counted_pairs(derived)
    return [f"succeeds in {ours} attacks | Faster R-CNN, white box, one view; noise: {noise}"]


def pairs_drawn(derived: Mapping[str, Any]) -> list[str]:
    """What the figure of DAGGER tells."""
    ours, theirs, noise = counted_pairs(derived)
    return [f"in {ours} attacks on Faster R-CNN, and in {theirs} on YOLOv8. Random noise: {noise}."]


def pairs_in_docs(derived: Mapping[str, Any]) -> list[str]:
    """The table of docs/dagger.md: what the paper's search does."""
    names = [group["labels"]["pair"].replace("sign to", "stop sign to") for group in six_pairs(derived)]
    return [
        f"| {name.replace(' to ', ', ')} | {count(group, 'success')} |"
        for name, group in zip(names, six_pairs(derived), strict=True)
    ] + [f"| {group['image_psnr']:.1f}, {group['psnr_object']:.1f} dB |" for group in six_pairs(derived)]


def strict_in_docs(derived: Mapping[str, Any]) -> list[str]:
    """What docs/dagger.md tells of the search that takes the own class away, and of what the paper's code does."""
    by_pair: dict[str, dict[str, Any]] = {}
    for group in derived["groups"]:
        if group["part"].startswith(("The paper's ball and steps", "Detectors trained on COCO")):
            name = group["labels"]["pair"].replace("sign to", "stop sign to")
            by_pair.setdefault(name.replace(" to ", ", "), {})[group["labels"]["detectors"]] = group
    cells = {pair: [count(by[name], "strict") for name in (*OUR, *COCO)] for pair, by in by_pair.items()}
    noise = [sum(group[key] for by in by_pair.values() for group in by.values()) for key in _NOISE]
    rows = result_of("dagger_strict").tables[ROWS].filter(splat=ATTACKED)
    wanted, gone = pl.col("target_score") >= REPORTED, pl.col("original_score") < LEFT
    ours, theirs, _ = counted_pairs(derived)
    lines = [
        f"Random noise of the same size never succeeds ({noise[0]} of {noise[1]})",
        f"in {ours} attacks on `fasterrcnn_small`",
        f"all attacks that count succeed ({theirs})",
    ]
    for part, name in (
        ("The search looks at the object alone", "the search looks at the object alone, on black; judged in the scene"),
        ("Every camera of the scene", "six cameras one after the other, seed 0; pictures"),
    ):
        these = [key for key, attack in derived["attacks"].items() if attack["part"].startswith(part)]
        looks = rows.filter(pl.col("attack").is_in(these)).select(a=wanted, b=wanted & gone, c=wanted | gone)
        of_all = " | ".join(f"{sum(column)}/{len(column)}" for column in looks)
        lines.append(f"| {name} | {of_all} |")
    return lines + [f" dB | {', '.join(values)} |" for values in cells.values()]


def strict_smallest(derived: Mapping[str, Any]) -> list[str]:
    """What docs/dagger.md says of smallest balls, where the clean object is found."""
    rows = result_of("dagger_strict_smallest").tables[ROWS].filter(splat=CLEAN)
    unseen = [
        {**derived["attacks"][name]["labels"], "attack.eps": None}
        for name in rows.filter(pl.col("original_score") < LEFT)["attack"]
    ]
    balls: dict[str, list[float]] = {}
    for line in derived["smallest"]:
        labels = line["labels"]
        if line["part"].startswith("11 steps") and {**labels, "attack.eps": None} not in unseen:
            balls.setdefault(labels["detectors"], []).append(line["smallest"] or float("inf"))
    assert all(max(of) > 3 for of in balls.values())
    names = [f"`{name}`" for name in (*OUR, *COCO) if max(balls[name]) <= 5]
    return [f"In a ball of 5 all six pairs hold with every seed on {' and '.join(names)}", "In a ball of 3 no detector"]


def strict_forty(derived: Mapping[str, Any]) -> list[str]:
    """What docs/dagger.md says of 40 steps in a ball of 3."""
    rows = result_of("dagger_strict_forty").tables[ROWS].filter(splat=CLEAN)
    seen = set(rows.filter(pl.col("original_score") >= LEFT)["attack"])
    by: dict[str, list[bool]] = {}
    for name, attack in derived["attacks"].items():
        if name in seen:
            by.setdefault(attack["part"], []).append(attack["strict"])
    none = by.pop("Faster R-CNN")
    assert all(any(strict) for strict in by.values())
    return [f"help all but `fasterrcnn_small` ({sum(none)} of {len(none)})"]


def count(group: Mapping[str, Any], key: str) -> str:
    return f"{group[key]['successes']}/{group[key]['total']}"


def from_one_view(derived: Mapping[str, Any], *, alone: bool, white_box: bool) -> Callable[[str], str]:
    """Rates over looks of attacks on one detector alone, or on several, from the attacked view."""
    looks = [
        look
        for look in derived["looks"]
        if (" + " not in look["labels"]["detectors"]) == alone and look["white_box"] == white_box
    ]

    def rate(name: str) -> str:
        counts = [sum(look[name][key] for look in looks) for key in ("successes", "total")]
        return f"{counts[0]} of {counts[1]}"

    return rate


def one_view_in_readme(derived: Mapping[str, Any]) -> list[str]:
    rate = from_one_view(derived, alone=True, white_box=False)
    return [f"attacks on one detector deceive another one from the same view in {rate('targeted')} runs"]


def one_view_in_docs(derived: Mapping[str, Any]) -> list[str]:
    attacked, fourth = (from_one_view(derived, alone=False, white_box=white) for white in (True, False))
    attacked_alone, another = (from_one_view(derived, alone=True, white_box=white) for white in (True, False))
    return [
        f"reports the wanted class in {attacked_alone('targeted')} runs",
        f"**{another('targeted')}** runs",
        f"loses the object's own class in {another('untargeted')}.",
        f"deceives each of the three in {attacked('targeted')} judgements",
        f"does not deceive the fourth: **{fourth('targeted')}**",
    ]


def open_images(derived: Mapping[str, Any]) -> list[str]:
    """What docs/dagger-coco.md tells of a detector of Open Images: as a judge of attacks on others."""
    looks = [
        look
        for look in derived["looks"]
        if look["part"].startswith("Attacks on others") and look["detector"] == "ssd_openimages"
    ]
    (both,) = {
        f"{sum(look[key]['successes'] for look in looks)} of {sum(look[key]['total'] for look in looks)}"
        for key in ("targeted", "untargeted")
    }
    return [f"show `ssd_openimages` no person, and do not take the car from it ({both} each)"]


def all_but_one(derived: Mapping[str, Any]) -> list[str]:
    """The table of docs/dagger-coco.md of the detector that is left out."""
    looks = [look for look in derived["looks"] if not look["white_box"]]
    counts = [[count(look, key) for key in ("targeted", "untargeted", "noise_untargeted")] for look in looks]
    assert len(looks) == 4
    return [
        f"| `{look['detector']}` | {person} | {lost if lost[0] != lost[-1] else f'**{lost}**'} | {noise} |"
        for look, (person, lost, noise) in zip(looks, counts, strict=True)
    ]


def open_images_all_around(derived: Mapping[str, Any]) -> list[str]:
    (one,) = derived["attacks"].values()
    rate, strict = one["rate"], one["strict_rate"]
    assert one["noise_rate"]["successes"] == 0
    return [
        f"in {rate['successes']} of {rate['total']} views that no search has seen. The car is gone, too, in "
        f"{strict['successes']}. Noise never succeeds",
    ]


def test_the_transfer_matrix_in_the_guide_is_that_of_the_rows() -> None:
    text = (ROOT / "docs" / "transfer.md").read_text()
    matrix = text.partition("## The matrix")[2].partition("## Over views")[0]
    cells = re.findall(r"\d+/\d+, \d+/\d+", matrix)
    looks = result_of("transfer").record["looks"]
    expected = Counter(f"{count(look, 'targeted')}, {count(look, 'untargeted')}" for look in looks)
    assert Counter(cells) == expected


def times_of_poison(derived: Mapping[str, Any]) -> list[str]:
    (one,) = (value for value in derived["values"] if (value["part"], value["value"]) == ("eps", "16"))
    return [f"{one['splats']['attacked']['times']['gaussians']['mean']:.1f} times the Gaussians"]


def rows_of_poison(derived: Mapping[str, Any]) -> list[str]:
    rows = []
    for value in derived["values"]:
        for name, splat in value["splats"].items():
            times, psnr = splat["times"]["gaussians"], splat["psnr"]
            if "grass" in value["part"]:
                undefended_by_another = "knows" in value["part"] and name == "attacked"
                rows += [] if undefended_by_another else [f"{times['mean']:.2f}, {psnr['mean']:.1f} dB"]
            elif name == "attacked":
                ends = "" if times["count"] == 1 else f" ({times['least']:.2f} to {times['most']:.2f})"
                rows.append(f"| {times['mean']:.2f}{ends} | {psnr['mean']:.1f} |")
    return rows


def misread(derived: Mapping[str, Any]) -> list[str]:
    seen = [
        line
        for line in derived["pooled"]
        if (line["detector"], line["condition"]) == ("prototypes", "held-out cameras")
    ]
    rates = [line["right"] for line in seen]
    return [f"{rate['successes']} of {rate['total']}" for rate in rates] + [
        f"{100 * rate['rate']:.1f} %" for rate in rates
    ]


def side_by_side(derived: Mapping[str, Any]) -> list[str]:
    """The table of docs/attack-zoo.md: successes of every attack by detector and together, looks, and CPU seconds."""
    lines = []
    members = by_attack([group for group in derived["groups"] if group["part"] == "car to person"])
    for name, groups in members.items():
        parts = [[group for group in groups if group["labels"]["detectors"] == detector] for detector in OUR]
        first, second, every = (pooled(group["success"] for group in part) for part in (*parts, groups))
        low, high = every.interval
        counts = (
            f"{first.successes}/{first.total} | {second.successes}/{second.total} | {every.successes}/{every.total}"
        )
        (looks,) = {group["evaluations"] for group in groups}
        seconds = sum(group["cpu_seconds"] for group in groups) / len(groups)
        lines.append(f"| `{name}` | {counts} ({low:.2f} to {high:.2f}) | {looks:g} | {seconds:.1f} |")
    return lines


SENTENCES: tuple[tuple[str, str, Callable[[Mapping[str, Any]], list[str]]], ...] = (
    ("dagger_eot_tried", "docs/research-log.md", tried),
    ("dagger_strict", "README.md", pairs_in_readme),
    ("dagger_strict", "docs/images/attack_dagger.svg", pairs_drawn),
    ("dagger", "docs/dagger.md", pairs_in_docs),
    ("dagger_strict", "docs/dagger.md", strict_in_docs),
    ("dagger_strict_smallest", "docs/dagger.md", strict_smallest),
    ("dagger_strict_forty", "docs/dagger.md", strict_forty),
    ("cloak_car_stealthy", "README.md", cloak_in_readme),
    ("cloak_car_stealthy", "docs/images/attack_cloak.svg", stealthy_drawn),
    ("cloak_car_stealthy", "docs/cloak.md", stealthy),
    ("cloak_car_sector", "docs/research-log.md", sector),
    ("cloak_car_layers", "README.md", cloak_in_readme),
    ("cloak_car_layers", "docs/cloak-layers.md", layers),
    ("cloak_car_layers_five", "docs/cloak-layers.md", layers_outside),
    ("cloak_car_layers_edges", "docs/cloak-layers.md", edges),
    ("dagger_eot_pairs", "README.md", all_cameras_in_readme),
    ("dagger_eot_pairs", "docs/dagger-eot.md", all_cameras_in_docs),
    ("dagger_openimages", "docs/dagger-coco.md", open_images),
    ("dagger_openimages_but_one", "docs/dagger-coco.md", all_but_one),
    ("dagger_eot_openimages", "docs/dagger-coco.md", open_images_all_around),
    ("poison_splat", "README.md", times_of_poison),
    ("poison_splat", "docs/poison-splat.md", times_of_poison),
    ("poison_splat", "docs/poison-splat.md", rows_of_poison),
    ("m_ifgsm", "docs/m-ifgsm.md", misread),
    ("attack_zoo", "docs/attack-zoo.md", side_by_side),
    ("poison_splat", "docs/images/attack_poison_splat.svg", times_of_poison),
    ("transfer", "README.md", one_view_in_readme),
    ("transfer", "docs/transfer.md", one_view_in_docs),
    ("transfer_views", "docs/transfer.md", others),
)
"""Artifacts whose figures stand in sentences: the page, and the sentences as the rows give them."""


@pytest.mark.parametrize(("name", "page", "tell"), SENTENCES)
def test_sentences_are_what_the_rows_give(name: str, page: str, tell: Callable[[Mapping[str, Any]], list[str]]) -> None:
    text = (ROOT / page).read_text()
    text = " ".join((re.sub("<[^>]*>", " ", text) if page.endswith(".svg") else text).split())
    assert [sentence for sentence in tell(result_of(name).record) if sentence not in text] == []
