"""Which detectors there are, how one of a user's own becomes one of them, and weights
that no detector can have.
"""

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file

from attacks import cli
from attacks.detectors import (
    DETECTORS,
    DetectorError,
    DetectorSpec,
    load_detector,
    register_detector,
)
from attacks.detectors.catalogue import (
    COCO_CLASSES,
    TORCHVISION_FILES,
    torch_download,
)
from attacks.detectors.torchvision import published_weights
from attacks.detectors.weights import apply_weights, read_weights
from attacks.testing import check_detector
from tests.detectors.contract import random_detector
from tests.fakes import ColourDetector

SPEC = DetectorSpec(
    name="fake_colour",
    load=lambda weights: ColourDetector(),
    classes=ColourDetector.classes,
    origin="a test",
    licence="none",
)


@pytest.fixture
def registered() -> Iterator[DetectorSpec]:
    register_detector(SPEC)
    yield SPEC
    del DETECTORS.own[SPEC.name]


def listed(capsys: pytest.CaptureFixture[str]) -> dict[str, dict[str, object]]:
    assert cli.main(["detectors", "--json"]) == 0
    return {
        entry["name"]: entry
        for entry in json.loads(capsys.readouterr().out)["detectors"]
    }


def test_a_registered_detector_is_loaded_and_listed(
    registered: DetectorSpec, capsys: pytest.CaptureFixture[str]
) -> None:
    assert isinstance(load_detector("fake_colour"), ColourDetector)
    entry = listed(capsys)["fake_colour"]
    assert entry["classes"] == ["car", "person", "stop sign"]
    assert entry["available"] is True
    assert (entry["origin"], entry["licence"], entry["weights"]) == (
        "a test",
        "none",
        "",
    )
    assert list(DETECTORS)[-1] == "fake_colour"
    assert len(DETECTORS) == len(list(DETECTORS))


def test_a_detector_without_a_way_to_move_is_refused_on_a_gpu(
    registered: DetectorSpec,
) -> None:
    with pytest.raises(
        DetectorError,
        match=r"detector fake_colour: expected one that can be moved to cuda",
    ):
        load_detector("fake_colour", device="cuda")


@pytest.mark.parametrize("name", ["fasterrcnn_small", "fake_colour"])
def test_a_name_is_given_once(registered: DetectorSpec, name: str) -> None:
    spec = DetectorSpec(
        name=name, load=SPEC.load, classes=("car",), origin="", licence=""
    )
    with pytest.raises(
        DetectorError, match=f"expected a name that is free, got '{name}'"
    ):
        register_detector(spec)


def test_what_is_missing_is_said() -> None:
    def spec(**more: object) -> DetectorSpec:
        return DetectorSpec(
            name="x",
            load=SPEC.load,
            classes=(),
            origin="",
            licence="",
            **more,  # type: ignore[arg-type]
        )

    assert spec().missing() == ""
    assert spec(weights=lambda: Path(__file__)).missing() == ""
    assert (
        spec(weights=lambda: Path("/nowhere"), advice="fetch them").missing()
        == "fetch them"
    )
    assert (
        spec(requires=("json", "no_such_package")).missing()
        == "needs the package no_such_package"
    )
    both = spec(
        requires=("no_such_package",),
        install="pip install it",
        weights=lambda: Path(__file__),
    )
    assert both.missing() == "needs the package no_such_package: pip install it"


def test_the_list_imports_no_library() -> None:
    code = (
        "import sys; from attacks import cli; status = cli.main(['detectors',"
        " '--json']); heavy = {'torch', 'torchvision', 'ultralytics', 'mitsuba',"
        " 'numpy'} & set(sys.modules); raise SystemExit(str(heavy) if heavy else"
        " status)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert '"available": true' in done.stdout


def test_torchvision_s_files_and_classes_are_the_library_s() -> None:
    for name, file in TORCHVISION_FILES.items():
        assert published_weights(name).url.rsplit("/", 1)[-1] == file
        categories = [
            label
            for label in published_weights(name).meta["categories"]
            if label not in ("__background__", "N/A")
        ]
        assert DETECTORS[name].classes == COCO_CLASSES == tuple(categories)


@pytest.mark.parametrize("variable", ["TORCH_HOME", "XDG_CACHE_HOME", None])
def test_downloads_are_looked_for_where_torch_keeps_them(
    variable: str | None, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    for name in ("TORCH_HOME", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)
    if variable is not None:
        monkeypatch.setenv(variable, str(tmp_path))
    monkeypatch.setattr(torch.hub, "_hub_dir", None)
    assert torch_download("w.pth") == Path(torch.hub.get_dir(), "checkpoints", "w.pth")
    assert os.environ.get("TORCH_HOME") == (
        str(tmp_path) if variable == "TORCH_HOME" else None
    )


def test_the_fingerprint_follows_every_weight() -> None:
    detector = random_detector("fasterrcnn_small", seed=0)
    first = detector.fingerprint
    assert len(first) == 16
    assert int(first, 16) >= 0
    assert random_detector("fasterrcnn_small", seed=0).fingerprint == first
    assert random_detector("fasterrcnn_small", seed=1).fingerprint != first
    with torch.no_grad():
        detector.model.roi_heads.box_predictor.cls_score.bias[3] += 1e-6
    assert detector.fingerprint != first


@pytest.mark.parametrize("bad", [torch.nan, -torch.inf])
@pytest.mark.parametrize("suffix", [".safetensors", ".pth"])
def test_weights_that_are_not_finite_are_refused(
    bad: float, suffix: str, tmp_path: Path
) -> None:
    """A detector of NaN finds nothing, so that every attack on it would seem to
    succeed.
    """
    state = {
        "good": torch.ones(3),
        "bad": torch.tensor([0.0, bad]).half(),
        "whole": torch.ones(2, dtype=torch.int64),
    }
    path = tmp_path / f"weights{suffix}"
    (save_file if suffix == ".safetensors" else torch.save)(state, path)
    with pytest.raises(
        DetectorError, match=r"weights\.\w+: expected finite numbers in bad, got others"
    ):
        read_weights(path)


def test_weights_of_another_kind_of_number_are_refused() -> None:
    state = {"weight": torch.ones(1, 2, dtype=torch.int64), "bias": torch.zeros(1)}
    with pytest.raises(DetectorError, match=r"float32, got weight of torch\.int64"):
        apply_weights(torch.nn.Linear(2, 1), state, "a file")


@pytest.mark.slow
def test_the_shipped_detector_keeps_the_contract() -> None:
    check_detector(load_detector("fasterrcnn_small"))
