"""Studies of poisoned training images: which jobs there are, what they leave, and
what is refused.
"""

import itertools
from collections import Counter
from pathlib import Path
from typing import Any

import polars as pl
import pytest

from attacks.classifiers.registry import CLASSIFIERS, ClassifierSpec
from attacks.cli import main
from attacks.cloak.config import SceneConfig
from attacks.detectors import registry
from attacks.figures.frame import read_figures
from attacks.observe.rows import rows
from attacks.studies.poison import PoisonWork, classifier_of
from attacks.studies.study_file import study_of
from mi_splat.datasets import load_dataset
from mi_splat.io.parsing import read_json
from tests.cloak.tiny_study import KNOWN
from tests.ledger.drive import Ledger
from tests.studies.toy import Toy

SMALL = """
study = "poison"
question = "Does it cost more?"
scene = { object = "tv", ground = "nothing" }
cameras = { train = 6, size = 24, samples = 1, points = 60 }
training = { iterations = 12, max_gaussians = "none", sh_degree = 0 }
evaluation = { cameras = 4 }

[[case]]
name = "kinds"
matrix.seed = [0, 1]
matrix.poison = [{ name = "noise", poison = { kind = "uniform-noise", eps = 8 } }]

[[case]]
name = "defended"
poison = { kind = "poison-splat", steps = 3, variation_steps = 2 }
defence = { filter = { name = "blur" } }
"""


def work(**changes: Any) -> PoisonWork:
    settings = {"study": "poison", "scene": {"object": "tv"}, **changes}
    return PoisonWork(study_of(settings, "toy"))


def test_a_study_is_done_and_shown(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("small.toml").write_text(SMALL)
    assert main(["study", "run", "small.toml", "--workers", "0"]) == 0
    folder = Path("out/studies/small")
    record = read_json(folder / "result.json")
    values = read_figures(folder).groups("part", "setting")
    assert [*values] == [("kinds", "noise"), ("defended", "defended")]
    noise, defended = values.values()
    assert noise.value("seeds") == 2
    assert noise.value("gaussians_ratio", splat="clean") == 1
    assert defended.labels("splat") == [
        "attacked",
        "attacked, defended",
        "clean",
        "clean, defended",
    ]
    paid = next(victim for victim in record["victims"] if victim["splat"] == "attacked")
    assert paid["peak_megabytes"] > 100
    assert 0 < paid["cpu_seconds"] < 100
    table = rows(folder, "fidelity")
    assert set(table["condition"].to_list()) == {None, "defended"}
    views = 4 * len(record["victims"])
    assert len(table) == views
    names = {path.stem for path in (folder / "pictures").glob("*.png")}
    assert {
        "kinds-noise-poisoned",
        "defended-defended-attacked-defended-centres",
    } <= names
    assert main(["artifact-check", str(folder)]) == 0
    assert main(["report", str(folder), "--out", "page.html"]) == 0


def test_poison_is_written_where_clean_pictures_are_clear(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    noisy = work(
        scene={"object": "tv", "ground": "nothing"},
        cameras={"train": 2, "size": 16, "samples": 1, "points": 20},
        training={"iterations": 1, "sh_degree": 0},
        poison={"kind": "uniform-noise", "eps": 16},
    ).attempts[0]
    assert noisy.poisoned is not None
    ledger = Ledger(Path("store"))
    clean, changed = (
        load_dataset(
            ledger.do(job).folder / "set",
            split="train",
            background=SceneConfig().background,
        )
        for job in (noisy.steps.pictures(), noisy.poisoned)
    )
    alpha = clean.alpha(0)
    assert alpha is not None
    difference = (changed[0].image - clean[0].image).abs().amax(-1)
    assert float(difference[alpha == 0].mean()) > 8 / 255
    assert float(difference.max()) <= 16.01 / 255


def test_which_jobs_share_their_work() -> None:
    poison = {"kind": "poison-splat"}
    labels = work(
        poison=poison, defence={"limit": 2.0}, matrix={"poison.eps": [8, 16]}
    ).jobs()
    kinds = [
        job.kind.rsplit(".", 1)[1]
        for job in {job.identity: job for job in labels.values()}.values()
    ]
    assert kinds.count("pictures") == 2  # of training and of held-out cameras
    assert kinds.count("poisoned") == 2
    # clean, clean and limited; of each poison both
    assert kinds.count("trained") == 1 + 1 + 2 + 2
    limited = next(
        job
        for label, job in labels.items()
        if label.endswith("training on attacked images, limited")
    )
    assert limited.config.limit == 2.0
    assert "clean" in limited.inputs
    black_box = work(poison=poison, attacker={"strategy": "mcmc"}).jobs()
    start = next(
        job for label, job in black_box.items() if label.endswith("by the attacker")
    )
    (changed,) = (
        job for label, job in black_box.items() if label.endswith("poisoning")
    )
    assert changed.sources["splat"].job is start  # type: ignore[union-attr]
    assert start.config.training.strategy == "mcmc"


def test_cloak_is_one_of_the_poisons() -> None:
    attack = {"name": "overhead", "appearance": "remove", "elevation": [50.0, 90.0]}
    jobs = work(
        poison={"kind": "cloak", "attack": [attack]}, training={"near": 0.1}
    ).jobs()
    poisoned = next(job for label, job in jobs.items() if label.endswith("poisoning"))
    assert poisoned.kind == "attacks.poisons.poisoned"
    victim = next(
        job for label, job in jobs.items() if label.endswith("attacked images")
    )
    assert victim.sources["pictures"].job is poisoned  # type: ignore[union-attr]


@pytest.mark.usefixtures("scalar")
def test_what_detectors_report(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    spec = ClassifierSpec(
        name="toy",
        load=lambda network, weights, classes: Toy("car", "tv"),
        origin="",
        licence="",
    )
    monkeypatch.setitem(CLASSIFIERS, "toy", spec)
    classifier_of.cache_clear()
    monkeypatch.setattr(registry.DETECTORS, "own", {**registry.DETECTORS.own, **KNOWN})
    monkeypatch.chdir(tmp_path)
    Path("seen.toml").write_text("""
study = "poison"
detectors = ["redness"]
classifiers = ["toy"]
deceive = "toy"
scene = { object = "car" }
cameras = { train = 6, size = 40, distance = 7.4, samples = 1, points = 600, \
hold_out = 3, elevations = [0, 20], azimuths = [-30, 60] }
training = { iterations = 12, sh_degree = 0 }
evaluation = { cameras = 6, confidence = 0.3 }
higher = 10
poison = { kind = "m-ifgsm", steps = 4, step = 0.5 }
defence = { filter = { name = "blur" } }
""")
    assert main(["study", "run", "seen.toml", "--workers", "0"]) == 0
    classifier_of.cache_clear()
    folder = Path("out/studies/seen")
    table = rows(folder)
    assert "depth: none" not in table.columns
    assert set(table["original"]) == {"car"}
    assert (table["success"] == (table["original_score"] < 0.3)).all()
    every = ("splat", "condition", "detector", "view")
    directions = {
        row[:4]: row[4:]
        for row in table.select(*every, "azimuth", "elevation", "distance").iter_rows()
    }
    assert all(
        directions[splat, condition, "toy", view] == pytest.approx(direction)
        for (splat, condition, _, view), direction in directions.items()
    )
    whole = table.with_columns(
        pl.col("azimuth").round() % 360, pl.col("elevation").round()
    )
    for where, *angles in (
        ("training cameras", (330, 30), (0, 20)),
        ("held-out cameras", (0,), (0, 20)),
        ("higher cameras", (330, 30), (10, 30)),
    ):
        seen_from = whole.filter(condition=where, detector="toy").select(
            "azimuth", "elevation"
        )
        assert set(seen_from.iter_rows()) == set(itertools.product(*angles))
    table = table.filter(detector="redness")
    counts = Counter(table.select("splat", "condition").iter_rows())
    assert counts == {
        **{
            (splat, "photograph, training cameras"): 4
            for splat in ("clean", "attacked")
        },
        ("clean", "photograph, held-out cameras"): 2,
        **{
            (splat, f"training cameras{how}"): 4
            for splat in ("clean", "attacked")
            for how in ("", ", defended")
        },
        **{
            (s, f"held-out cameras{how}"): 2
            for s in ("clean", "attacked")
            for how in ("", ", defended")
        },
    }
    record = read_json(folder / "result.json")
    assert record["detectors"] == {"redness": "0" * 16}
    figures = read_figures(folder)
    assert {
        name for (name,), of in figures.groups("detector").items() if of.rates("named")
    } == {"toy"}
    photographs = figures.where(
        setting="the study", part="seen", condition="photograph, training cameras"
    )
    clean, attacked = (
        photographs.rate("found", detector="redness", splat=splat)
        for splat in ("clean", "attacked")
    )
    assert clean.successes > attacked.successes
    assert (
        "How often the object is found as what it is"
        in (folder / "table.md").read_text()
    )
    assert main(["artifact-check", str(folder)]) == 0
