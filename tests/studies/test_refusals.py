"""What no study can be is refused before its first job, by a message that names what
was meant.
"""

from pathlib import Path
from typing import Any

import pytest

from attacks.classifiers.registry import CLASSIFIERS, ClassifierSpec
from attacks.detectors import registry
from attacks.studies.running import work_of
from attacks.studies.study_file import read_study, study_of
from mi_splat.errors import InvalidValueError
from tests.cloak.tiny_study import KNOWN
from tests.project.layers import ROOT
from tests.studies.toy import Toy, settings, write_toy

pytestmark = pytest.mark.usefixtures("toys")


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("", "study in s: expected dagger or dagger-eot, got 'None'|got None"),
        ('study = "daggr"', "did you mean dagger"),
        ('study = "dagger"\nmatrix = 3', "matrix in s: expected a table, got 3"),
        (
            'study = "dagger"\n[matrix]\nseed = 3',
            "seed in s: expected a list of one or more values, got 3",
        ),
        (
            'study = "dagger"\n[matrix]\nseed = []',
            "seed in s: expected a list of one or more values",
        ),
        ('study = "dagger"\n[matrix]\nseed = [1, 1]', "values with different names"),
        (
            'study = "dagger"\n[[case]]\nmatrix = { seed = [1] }',
            "case in s: expected names",
        ),
        ('study = "dagger"\n[case]\nname = "a"', r"write \[\[case\]\]"),
        ('study = "dagger"\n[bisect]\nfield = "a"', "bisect in s"),
        ('study = "dagger"\n[bisect]\nfield = "a"\nvalues = [2, 1]', "rising numbers"),
    ],
)
def test_files(text: str, match: str, tmp_path: Path) -> None:
    path = tmp_path / "s.toml"
    path.write_text(text)
    with pytest.raises(Exception, match=match):
        read_study(path)


@pytest.mark.parametrize(
    ("changes", "match"),
    [
        ({"targt": "tv"}, "did you mean target"),
        ({"attack": {"ep": 1.0}}, "did you mean eps"),
        ({"target": "persn"}, "did you mean person"),
        ({"aim": "hide"}, "target: expected what the aim hide has, got person"),
        ({"target": "none"}, "name the class wanted"),
        ({"detectors": "fake_colors"}, "did you mean fake_colour"),
        ({"scene": "nowhere.xml"}, "nowhere.xml"),
        ({"object": "cat"}, "expected one of rest, car, got cat; did you mean car"),
        ({"camera": 2}, "expected 0 to 1, got 2"),
        ({"renderer": "rey"}, "did you mean ray"),
        ({"gradient": "rey"}, "did you mean ray"),
        ({"evaluate_with": {"condition": "rey"}}, "did you mean ray"),
        ({"evaluate_with": {"condition": "09:30"}}, "need .evaluate_with.sun."),
        (
            {"evaluate_with": {"matrix": {"condition": ["", "as attacked"]}}},
            "got 2: fake_colour, own renderer",
        ),
    ],
)
def test_studies_of_dagger(changes: dict[str, Any], match: str, tmp_path: Path) -> None:
    write_toy(tmp_path)
    with pytest.raises(Exception, match=match):
        work_of(study_of(settings(tmp_path, **changes), "toy"))


def test_threats_are_refused_whose_objects_are_not_where_looks_expect_them(
    tmp_path: Path,
) -> None:
    write_toy(tmp_path)
    attack = {"eps": 0.1, "steps": 4, "attributes": ["shift"]}
    table = settings(tmp_path, attack=attack)
    with pytest.raises(InvalidValueError, match=r"attributes: .*sh, got shift"):
        work_of(study_of(table, "toy")).jobs()


STREET = str(ROOT / "scenes" / "mixed" / "car_among_meshes.xml")
ABOVE = {"name": "a", "elevation": [50, 90]}
CLOAK: dict[str, Any] = {"study": "cloak", "attack": [ABOVE]}
POISON: dict[str, Any] = {"study": "poison", "scene": {"object": "tv"}}
MISREAD = {"kind": "m-ifgsm"}


@pytest.mark.parametrize(
    ("table", "match"),
    [
        (
            {"study": "cloak", "base": "nowhere.toml"},
            "base of toy: expected a TOML file, got no file nowhere.toml",
        ),
        ({**CLOAK, "colour": 1}, "colour"),
        (
            {**CLOAK, "bisect": {"field": "cameras.train", "values": [8, 9]}},
            "expected no bisect",
        ),
        (
            {**CLOAK, "evaluate_with": {"matrix": {"condition": [".spx"]}}},
            "did you mean .spz",
        ),
        (
            {
                **CLOAK,
                "evaluate_with": {"condition": "ray", "matrix": {"every": [4, 9]}},
            },
            "got 2: .* seed 0, ray",
        ),
        (
            {
                **CLOAK,
                "evaluate_with": {
                    "sun": {"scene": STREET},
                    "matrix": {"condition": ["09:30"]},
                },
            },
            "expected layers",
        ),
        (
            {**CLOAK, "attack": [{"name": "a", "elevation": [89.99, 90]}]},
            "expected at least one camera",
        ),
        (
            {**POISON, "poison": {"kind": "poison"}},
            "kind of toy, poison: expected .*poison-splat.*got poison",
        ),
        ({**POISON, "poison": "splat"}, "toy, poison: expected a table, got 'splat'"),
        (
            {**POISON, "poison": {"kind": "uniform-noise", "steps": 3}},
            "key in toy, poison: expected .*eps",
        ),
        (
            {**POISON, "poison": {"kind": "poison-splat", "eps": 300}},
            "eps: expected .*255",
        ),
        (
            {**POISON, "defence": {}},
            "defence.*one of filter, limit and prune, got none",
        ),
        (
            {**POISON, "defence": {"limit": 1.0, "filter": {"name": "blur"}}},
            "one of filter, limit and prune",
        ),
        ({**POISON, "defense": {"limit": 1.0}}, "key in toy.*defence"),
        (
            {**POISON, "evaluate_with": {"matrix": {"condition": ["ray"]}}},
            "no table evaluate_with",
        ),
        (
            {**POISON, "detectors": ["redness"]},
            "class for redness: expected one of car, stop sign, got tv",
        ),
        ({**POISON, "poison": MISREAD}, "a classifier that M-IFGSM deceives, got none"),
        (
            {
                "study": "poison",
                "scene": {"object": "bird"},
                "poison": MISREAD,
                "deceive": "toy",
            },
            "tv, car, got bird",
        ),
        (
            {**POISON, "poison": {**MISREAD, "target": "tv"}, "deceive": "toy"},
            "target for toy: .* car, got tv",
        ),
        ({**POISON, "classifiers": ["toys"]}, "classifier: expected .*toy"),
    ],
)
def test_studies_of_other_kinds(
    table: dict[str, Any], match: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    spec = ClassifierSpec(
        name="toy", load=lambda network, weights, classes: Toy(), origin="", licence=""
    )
    monkeypatch.setitem(CLASSIFIERS, "toy", spec)
    monkeypatch.setattr(registry.DETECTORS, "own", {**registry.DETECTORS.own, **KNOWN})
    with pytest.raises(Exception, match=match):
        work_of(study_of(table, "toy"))
