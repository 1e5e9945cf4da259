"""The studies in scenes/studies can be done, and ask what they always asked."""

import lzma
import runpy
from pathlib import Path

import polars as pl
import pytest

from attacks.cloak.steps import StudySteps
from attacks.cloak.study import check_study
from attacks.detectors.weights import FrozenModel
from attacks.studies import cloak, dagger, poison
from attacks.studies.cloak import config_of
from attacks.studies.running import work_of
from attacks.studies.study_file import read_study
from mi_splat.capture.objects import OBJECTS
from tests.cloak.tiny_study import Redness
from tests.project.layers import ROOT
from tests.studies.toy import Toy

pytestmark = pytest.mark.shipped

STUDIES = ROOT / "scenes" / "studies"
COUNTS = {
    "attack_zoo": (225, 0),
    "between_renderers": (54, 432),
    "cloak": (35, 0),
    "cloak_controls": (8, 0),
    "cloak_design": (17, 0),
    "cloak_elsewhere": (1, 132),
    "cloak_new_cars": (5, 0),
    "cloak_robust": (2, 0),
    "cloak_second_car": (1, 0),
    "coco": (72, 0),
    "coco_demo": (12, 0),
    "coco_smallest": (252, 0),
    "dagger": (456, 0),
    "dagger_cameras": (2448, 0),
    "dagger_code": (24, 0),
    "eot_pairs": (19, 0),
    "eot_settings": (38, 0),
    "eot_smallest": (66, 0),
    "eot_views": (6, 24),
    "files": (48, 480),
    "gradients": (66, 66),
    "m_ifgsm": (24, 0),
    "m_ifgsm_demo": (2, 0),
    "m_ifgsm_sparse": (65, 0),
    "narrow": (12, 96),
    "narrow_curves": (26, 0),
    "openimages": (48, 240),
    "third_party_detectors": (120, 240),
    "pairs": (6, 0),
    "poison_demo": (3, 0),
    "poison_splat": (63, 0),
    "renderers_light": (3, 0),
    "renderers_path": (9, 0),
    "renderers_trained": (4, 0),
    "sanity": (78, 156),
    "sun": (12, 72),
    "transfer": (144, 576),
}
"""Points of each study, or of poisons the trainings; and looks by judges."""
LONG = ("cloak", "cloak_design", "cloak_controls", "cloak_new_cars", "cloak_second_car")
"""Studies whose scenes take seconds to build."""


@pytest.mark.parametrize("name", LONG)
def test_the_points_of_a_long_study_have_settings_that_can_be(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(ROOT)
    study = read_study(STUDIES / f"{name}.toml")
    assert len(study.points) == COUNTS[name][0]
    for point in study.points:
        assert config_of(point.settings, name).attack


@pytest.mark.parametrize(
    "path",
    [
        pytest.param(
            path, id=path.stem, marks=[pytest.mark.nightly] if path.stem in LONG else []
        )
        for path in sorted(STUDIES.glob("*.toml"))
    ],
)
def test_a_shipped_study_is_so_many_jobs(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(ROOT)
    if path.stem == "third_party_detectors":
        pytest.importorskip(
            "rapidocr_onnxruntime", reason="the extra ocr is not installed"
        )
    # that were not fetched are not missed
    monkeypatch.setattr(dagger, "weights", lambda detectors: {})
    monkeypatch.setattr(FrozenModel, "fingerprint", "0" * 16)  # takes seconds
    monkeypatch.setattr(cloak, "detectors_of", lambda config, weights: [Redness()])

    def check(steps: StudySteps, detectors: object) -> None:
        # the cameras of long studies are checked, too
        if path.stem in LONG:
            check_study(steps, [])

    monkeypatch.setattr(cloak, "check_study", check)
    monkeypatch.setattr(poison, "classifier_of", lambda name: Toy(*OBJECTS))
    study = read_study(path)
    work = work_of(study)
    looks = sum(len(getattr(one, "looks", ())) for one in work.attempts)
    trained = {
        job.identity for job in work.jobs().values() if job.kind.endswith(".trained")
    }
    assert (
        len(trained) if study.kind == "poison" else len(work.attempts),
        looks,
    ) == COUNTS[path.stem]
    assert study.question.endswith("?")
    if study.kind.startswith("dagger"):
        assert len({one.title for one in work.attempts}) == len(work.attempts)


# The tables of the rendering studies in the documentation are counted from their rows,
# one for each look at each attack


TABLES = ROOT / "docs" / "tables"
STUDY_TABLES = runpy.run_path(
    str(ROOT / "docs" / "sphinx_extensions" / "study_tables.py")
)


@pytest.mark.parametrize(
    ("name", "attacks", "line"),
    [
        (
            "between_renderers",
            54,
            "| tile | 8/9 (0.57 to 0.98) | 1/9 (0.02 to 0.43) | 0/9 (0.00 to 0.30) |",
        ),
        (
            "gradients",
            66,
            "| tile | 6/6 (0.61 to 1.00) | 5/6 (0.44 to 0.97) | 3/6 (0.19 to 0.81) |",
        ),
        (
            "files",
            48,
            (
                "| .splat | 0/12 (0.00 to 0.24) | 0/12 (0.00 to 0.24) | 0/12 (0.00 to"
                " 0.24) |"
            ),
        ),
        ("sun", 12, "| 07:00 | 3/5 (0.23 to 0.88) | 0/5 |"),
    ],
)
def test_tables_of_the_rendering_studies_are_counted_from_their_rows(
    name: str, attacks: int, line: str
) -> None:
    text = STUDY_TABLES["page"](name, TABLES)
    assert f"{attacks} attacks: " in text
    assert line in text
    conclusions = (ROOT / "docs" / "rendering-studies.md").read_text()
    assert f"](tables/study_{name}.md)" in conclusions


def test_figures_of_compared_renderers_are_those_of_their_rows() -> None:
    page = (ROOT / "docs" / "rendering-studies.md").read_text()
    table = lzma.decompress((TABLES / "comparing_renderers.csv.xz").read_bytes())
    rows = pl.read_csv(table, infer_schema_length=None).rows()
    for distance in ("8.0", "2.0", "1.0", "0.1"):
        cells = [
            f"{row[4]:.1f}"
            for row in rows
            if row[1] == distance and row[3] == "psnr" and "ray" in row[2]
        ]
        assert all(f" {cell} |" in page for cell in cells), distance
