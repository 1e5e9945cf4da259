"""Studies of poisoned training pictures: which jobs there are, what they leave, and what is refused."""

from collections import Counter
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from attacks.classifiers.registry import CLASSIFIERS, ClassifierSpec
from attacks.cli import main
from attacks.cloak.config import SceneConfig
from attacks.detectors import registry
from attacks.detectors.weights import FrozenModel
from attacks.observe.rows import rows
from attacks.studies.poison import PoisonWork, classifier_of
from attacks.studies.study_file import read_study, study_of
from mi_splat.assets import ASSETS
from mi_splat.datasets import load_dataset
from mi_splat.errors import InvalidValueError, MiSplatError
from mi_splat.io.parsing import read_json
from tests.cloak.tiny_study import KNOWN
from tests.ledger.drive import Ledger
from tests.project.layers import ROOT

SMALL = """
study = "poison"
question = "Does it cost more?"
scene = { object = "tv", ground = "nothing" }
cameras = { train = 6, size = 24, samples = 1, points = 60 }
training = { iterations = 12, max_gaussians = "none", sh_degree = 0 }
evaluation = { cameras = 4 }

[[case]]
name = "kinds"
matrix = { seed = [0, 1], poison = [{ name = "noise", poison = { kind = "uniform-noise", eps = 8 } }] }

[[case]]
name = "defended"
poison = { kind = "poison-splat", steps = 3, variation_steps = 2 }
defence = { filter = { name = "blur" } }

[[case]]
name = "afford"
victim = { seconds = 1e-6 }
"""


def work(**changes: Any) -> PoisonWork:
    settings = {"study": "poison", "scene": {"object": "tv"}, **changes}
    return PoisonWork(study_of(settings, "toy"))


def test_a_study_is_done_and_shown(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("small.toml").write_text(SMALL)
    assert main(["study", "run", "small.toml", "--workers", "0"]) == 0
    folder = Path("out/studies/small")
    record = read_json(folder / "result.json")
    values = {f"{value['part']}: {value['value']}": value for value in record["values"]}
    assert [*values] == ["kinds: noise", "defended: defended", "afford: afford"]
    assert values["kinds: noise"]["seeds"] == [0, 1]
    assert values["kinds: noise"]["splats"]["clean"]["times"]["gaussians"]["mean"] == 1
    assert [*values["defended: defended"]["splats"]] == ["attacked", "attacked, defended", "clean", "clean, defended"]
    assert values["afford: afford"]["splats"]["clean"]["stopped"] == 1
    stopped = next(victim for victim in record["victims"] if victim["part"] == "afford")
    assert stopped["stopped"] == "after 1 steps: more than 1e-06 seconds"
    assert (stopped["steps"], stopped["gaussians"]) == (1, 60)
    paid = next(victim for victim in record["victims"] if victim["splat"] == "attacked")
    assert paid["peak_megabytes"] > 100
    assert 0 < paid["cpu_seconds"] < 100
    table = rows(folder, "fidelity")
    assert set(table["condition"].to_list()) == {None, "defended"}
    views = 4 * len(record["victims"])
    assert len(table) == views
    names = {path.stem for path in (folder / "pictures").glob("*.png")}
    assert {"kinds-noise-poisoned", "defended-defended-attacked-defended-centres"} <= names
    assert main(["artifact-check", str(folder)]) == 0
    assert main(["report", str(folder), "--out", "page.html"]) == 0


def test_poison_is_written_where_clean_pictures_are_clear(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
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
        load_dataset(ledger.do(job).folder / "set", split="train", background=SceneConfig().background)
        for job in (noisy.steps.pictures(), noisy.poisoned)
    )
    alpha = clean.alpha(0)
    assert alpha is not None
    difference = (changed[0].image - clean[0].image).abs().amax(-1)
    assert float(difference[alpha == 0].mean()) > 8 / 255
    assert float(difference.max()) <= 16.01 / 255


def test_which_jobs_share_their_work() -> None:
    poison = {"kind": "poison-splat"}
    labels = work(poison=poison, defence={"limit": 2.0}, matrix={"poison.eps": [8, 16]}).jobs()
    kinds = [job.kind.rsplit(".", 1)[1] for job in {job.identity: job for job in labels.values()}.values()]
    assert kinds.count("pictures") == kinds.count("true_pictures") == 1
    assert kinds.count("poisoned") == 2
    assert kinds.count("trained") == 1 + 1 + 2 + 2  # clean, clean and limited; of each poison both
    limited = next(job for label, job in labels.items() if label.endswith("training on attacked pictures, limited"))
    assert limited.config.limit == 2.0
    assert "clean" in limited.inputs
    black_box = work(poison=poison, attacker={"strategy": "mcmc"}).jobs()
    start = next(job for label, job in black_box.items() if label.endswith("by the attacker"))
    (changed,) = (job for label, job in black_box.items() if label.endswith("poisoning"))
    assert changed.sources["splat"].job is start  # type: ignore[union-attr]
    assert start.config.training.strategy == "mcmc"


def test_cloak_is_one_of_the_poisons() -> None:
    attack = {"name": "overhead", "appearance": "remove", "elevation": [50.0, 90.0]}
    jobs = work(poison={"kind": "cloak", "attack": [attack]}, training={"near": 0.1}).jobs()
    poisoned = next(job for label, job in jobs.items() if label.endswith("poisoning"))
    assert poisoned.kind == "attacks.poisons.poisoned"
    victim = next(job for label, job in jobs.items() if label.endswith("attacked pictures"))
    assert victim.sources["pictures"].job is poisoned  # type: ignore[union-attr]


@pytest.mark.parametrize(
    ("changes", "match"),
    [
        ({"poison": {"kind": "poison"}}, "kind of toy, poison: expected .*poison-splat.*got poison"),
        ({"poison": "splat"}, "toy, poison: expected a table, got 'splat'"),
        ({"poison": {"kind": "uniform-noise", "steps": 3}}, "key in toy, poison: expected .*eps"),
        ({"poison": {"kind": "poison-splat", "eps": 300}}, "eps: expected .*255"),
        ({"defence": {}}, "defence.*one of filter, limit and prune, got none"),
        ({"defence": {"limit": 1.0, "filter": {"name": "blur"}}}, "one of filter, limit and prune"),
        ({"defense": {"limit": 1.0}}, "key in toy.*defence"),
        ({"judge": {"matrix": {"condition": ["ray"]}}}, "no judge"),
        ({"victim": {"device": "gpu"}}, "device: expected one of cpu, cuda"),
    ],
)
def test_what_cannot_be_is_refused_before_a_job(changes: dict[str, Any], match: str) -> None:
    with pytest.raises(InvalidValueError, match=match):
        work(**changes)


class Toy:
    """Takes what is red for a tv."""

    name, fingerprint, size = "toy", "0123456789abcdef", 16
    classes: tuple[str, ...] = ("tv", "car")

    def scores(self, images: Tensor) -> Tensor:
        """Logits."""
        red = images[..., 0].mean((1, 2)) - images[..., 2].mean((1, 2))
        return 20 * torch.stack([red + 0.35, -red - 0.35], 1)


def test_who_is_deceived_and_who_looks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    spec = ClassifierSpec(name="toy", load=lambda network, weights, classes: Toy(), origin="", licence="")
    monkeypatch.setitem(CLASSIFIERS, "toy", spec)
    monkeypatch.chdir(tmp_path)
    head, *_ = SMALL.partition("[[case]]")
    more = 'deceive = "toy"\nclassifiers = ["toy"]\npoison = { kind = "m-ifgsm", steps = 4, step = 0.2 }\n'
    Path("misread.toml").write_text(head + more)
    assert main(["study", "run", "misread.toml", "--workers", "0"]) == 0
    told = read_json(Path("out/studies/misread/result.json"))["classified"]
    seen = {(line["splat"], line["condition"]): line["confidence"] for line in told}
    photograph = "photograph, training cameras"
    assert {*seen} >= {("clean", "held-out cameras"), ("attacked", "training cameras"), ("clean", photograph)}
    assert seen["attacked", photograph] < seen["clean", photograph] - 0.02
    assert (
        len(rows("out/studies/misread")) == 3 * (6 + 4) + 6
    )  # clean: splat, photographs; attacked: splat, poisoned ones
    assert main(["artifact-check", "out/studies/misread"]) == 0


@pytest.mark.usefixtures("scalar")
def test_what_detectors_report(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    toy = Toy()
    toy.classes = ("car", "tv")
    spec = ClassifierSpec(name="toy", load=lambda network, weights, classes: toy, origin="", licence="")
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
cameras = { train = 6, size = 40, distance = 7.4, samples = 1, points = 600, elevations = [0.0, 20.0] }
training = { iterations = 12, sh_degree = 0 }
evaluation = { cameras = 4, confidence = 0.3 }
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
    directions = {row[:4]: row[4:] for row in table.select(*every, "azimuth", "elevation", "distance").iter_rows()}
    assert all(
        directions[splat, condition, "toy", view] == pytest.approx(direction)
        for (splat, condition, _, view), direction in directions.items()
    )
    table = table.filter(detector="redness")
    counts = Counter(table.select("splat", "condition").iter_rows())
    held_out = len(set(rows(folder, "fidelity")["view"]))
    assert counts == {
        **{(splat, "photograph, training cameras"): 6 for splat in ("clean", "attacked")},
        ("clean", "photograph, held-out cameras"): held_out,
        **{(splat, f"training cameras{how}"): 6 for splat in ("clean", "attacked") for how in ("", ", defended")},
        **{(s, f"held-out cameras{how}"): held_out for s in ("clean", "attacked") for how in ("", ", defended")},
    }
    record = read_json(folder / "result.json")
    assert record["detectors"] == {"redness": "0" * 16}
    assert {line["detector"] for line in record["classified"]} == {"toy"}
    seen = {(line["splat"], line["condition"]): line for line in record["detected"]}
    photograph = "photograph, training cameras"
    assert seen["clean", photograph]["right"]["successes"] > seen["attacked", photograph]["right"]["successes"]
    assert "How often the object is found as what it is" in (folder / "table.md").read_text()
    assert main(["artifact-check", str(folder)]) == 0


def test_a_detector_has_to_be_there_and_to_know_the_object(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(registry.DETECTORS, "own", {**registry.DETECTORS.own, **KNOWN})
    with pytest.raises(InvalidValueError, match="class for redness: expected one of car, stop sign, got tv"):
        work(detectors=["redness"])
    with pytest.raises(MiSplatError, match=r"detector: expected .*redness"):
        work(detectors=["rednes"])


def test_a_classifier_has_to_be_there_and_to_know_the_object(monkeypatch: pytest.MonkeyPatch) -> None:
    spec = ClassifierSpec(name="toy", load=lambda network, weights, classes: Toy(), origin="", licence="")
    monkeypatch.setitem(CLASSIFIERS, "toy", spec)
    poison = {"kind": "m-ifgsm"}
    with pytest.raises(InvalidValueError, match="a classifier that M-IFGSM deceives, got none"):
        work(poison=poison)
    with pytest.raises(InvalidValueError, match="class for toy: expected one of tv, car, got bird"):
        work(poison=poison, deceive="toy", scene={"object": "bird"})
    for target in ("tv", "bird"):
        with pytest.raises(InvalidValueError, match=f"target for toy: expected one of car, got {target}"):
            work(poison={**poison, "target": target}, deceive="toy", scene={"object": "tv"})
    with pytest.raises(InvalidValueError, match=r"classifier: expected .*toy"):
        work(classifiers=["toys"])


@pytest.mark.parametrize(
    ("name", "sets", "victims"),
    [("poison_splat", 38, 63), ("m_ifgsm", 55, 65), ("poison_demo", 2, 3), ("m_ifgsm_demo", 2, 4)],
)
def test_the_shipped_studies_can_be_done(name: str, sets: int, victims: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(FrozenModel, "fingerprint", "0" * 16)  # of every look's detector, which takes seconds
    toy = Toy()
    toy.classes = tuple(ASSETS)
    spec = ClassifierSpec(name="prototypes", load=lambda network, weights, classes: toy, origin="", licence="")
    monkeypatch.setitem(CLASSIFIERS, "prototypes", spec)
    classifier_of.cache_clear()
    jobs = {
        job.identity: job
        for job in PoisonWork(read_study(ROOT / "scenes" / "studies" / f"{name}.toml")).jobs().values()
    }
    classifier_of.cache_clear()
    kinds = Counter(job.kind.rsplit(".", 1)[1] for job in jobs.values())
    assert (kinds["poisoned"], kinds["trained"]) == (sets, victims)
