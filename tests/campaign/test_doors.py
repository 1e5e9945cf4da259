"""Every public reader of files is a kind of the campaign: a new one without a kind
fails here.
"""

from attacks.detectors.weights import SUFFIXES as WEIGHTS
from attacks.report.results import RESULT_KINDS
from attacks.studies.study_file import KINDS as STUDY_KINDS
from attacks.studies.study_file import read_study
from mi_splat.io.picture_files import FORMATS as IMAGES
from mi_splat.io.splat_files import SUFFIXES as SPLATS
from tests.campaign.doors import decoding_modules, public_readers
from tests.campaign.kinds import KINDS
from tests.campaign.of_results import STUDIES
from tests.project.layers import ROOT

WITHOUT = {
    "attacks.classifiers.prototypes:load_features": "weights, by `read_weights`",
    "attacks.classifiers.prototypes:load_prototypes": (
        "the kind `prototypes` reads what it reads of others"
    ),
    "attacks.detectors.graphs.graph:read_frozen": "bytes whose SHA-256 is known",
    "attacks.detectors.graphs.graph:read_graph_model": "bytes whose SHA-256 is known",
    "attacks.detectors.graphs.graph:read_tflite": "bytes whose SHA-256 is known",
    "mi_splat.io.ply:read_rows": (
        "a part of `read_ply`, called by `load_points` alone besides"
    ),
}
"""Public readers that need no kind, and why."""
MODULES_WITHOUT = {
    **dict.fromkeys(
        (
            *("attacks.audits.gated", "attacks.audits.judging"),
            *("mi_splat.preparation.prepare", "mi_splat.preparation.worker"),
        ),
        "messages between our own processes",
    ),
    **dict.fromkeys(
        (
            "attacks.cli.summary",
            "attacks.cli.doctor",
            "mi_splat.cli.train",
            "mi_splat.cli.capture",
            "mi_splat.cli.conform_pack",
        ),
        "what the same command has just written",
    ),
    **dict.fromkeys(
        ("attacks.studies.compare", "attacks.studies.dagger", "attacks.studies.poison"),
        "files of a job, whose digests were checked",
    ),
    "attacks.classifiers.prototypes": "the kind `prototypes`",
    "attacks.detectors.graphs.graph": "bytes whose SHA-256 is known",
    "attacks.detectors.registry": "a variable that this program sets",
    "attacks.studies.cloak": "a table of a study, in the kinds `study ...`",
    "attacks.transformations.draws": "a JPEG that was encoded there",
    "mi_splat.capture.mitsuba_scene": "arrays of a mesh that was read",
}
"""Modules that turn bytes into values and need no kind, and why."""
READERS = {reader for kind in KINDS.values() for reader in kind.readers}


def _suffixes(first: str) -> list[str]:
    return [name for name in KINDS if name.split()[0] == first]


def test_every_public_reader_is_a_kind() -> None:
    readers = public_readers()
    assert readers - READERS == WITHOUT.keys(), (
        "give a new reader a kind in tests/campaign/kinds.py"
    )


def test_every_module_that_decodes_is_read_by_a_kind() -> None:
    modules = {reader.partition(":")[0] for reader in READERS}
    assert decoding_modules() - modules == MODULES_WITHOUT.keys(), (
        "give a new reader a kind in tests/campaign/kinds.py"
    )


def test_every_entry_of_a_registry_is_a_kind() -> None:
    for suffix in SPLATS:
        assert [name for name in _suffixes("splat") if name.endswith(suffix)], suffix
    for suffix in WEIGHTS:
        assert f"weights w{suffix}" in KINDS
    assert len([name for name in _suffixes("image") if " p." in name]) == len(IMAGES)
    assert {kind.name for kind in RESULT_KINDS} == {
        name.partition(" ")[2] for name in _suffixes("result")
    }
    assert {read_study(ROOT / f"scenes/{name}.toml").kind for name in STUDIES} == {
        *STUDY_KINDS
    }
