"""`mi-splat poison` with kinds other than CLOAK: what changes on the disk, what stays,
and what is refused.
"""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import torch

from attacks import cli
from attacks.classifiers.registry import CLASSIFIERS, ClassifierSpec
from attacks.cli.poison import kind_names
from attacks.poisons.base import ImagePoison, OnStep, Poisoned, mask_of, poisoned
from attacks.poisons.specs import POISONS, Given, PoisonSpec
from mi_splat.cameras.camera import View
from mi_splat.cameras.framing import near_plane
from mi_splat.cameras.lens import Lens
from mi_splat.cameras.sets import orbit
from mi_splat.datasets import Dataset, load_dataset
from mi_splat.io import load_splat, save_splat
from mi_splat.io.picture_files import load_picture
from mi_splat.render import variant
from mi_splat.render.renderer import Renderer, RenderSettings
from mi_splat.selection.config import Selection
from mi_splat.selection.select import SEEN, select
from mi_splat.selection.visibility import object_weight
from tests.classifiers.made import toy_classifier
from tests.datasets.sets import write_transforms
from tests.gaussians import varied_scene

SPLAT = varied_scene(30, degree=1, seed=9)
CAMERAS = orbit(
    (0.0, 0.0, 0.0),
    count=5,
    elevation=20.0,
    distance=4.0,
    lens=Lens(focal=24.0, size=(20, 16)),
)
NONE = ("--eps", "0")
SMALL = {
    "poison-splat": ("--steps", "3", "--variation-steps", "2", "--through", "blur"),
    "uniform-noise": (),
    "raised-variation": ("--variation-steps", "2"),
    "m-ifgsm": (
        "--classifier",
        "toy",
        "--label",
        "car",
        "--cluster",
        "1",
        "--steps",
        "3",
        "--least-confidence",
        "0",
    ),
}


@pytest.fixture(scope="module")
def names(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """A set whose images have masks, and are clear on the left; its PNG files are of
    another writer.
    """
    folder = tmp_path_factory.mktemp("set")
    render = Renderer(RenderSettings(near=0.1))
    with torch.no_grad():
        views = [View(camera, render(SPLAT, camera).clamp(0, 1)) for camera in CAMERAS]
    alpha = torch.ones(16, 20)
    mask = torch.ones(16, 20)
    alpha[:, :4], alpha[:, 4:8], mask[12:] = 0, 0.4, 0
    write_transforms(
        folder / "set", views[:4], test=views[4:], alphas=[alpha] * 5, masks=[mask] * 5
    )
    for file in (folder / "set" / "images").iterdir():
        load_picture(file).save(file, compress_level=0)
    save_splat(SPLAT, folder / "splat.ply")
    return [str(folder / "set"), str(folder / "splat.ply")]


@pytest.fixture(autouse=True)
def toy(monkeypatch: pytest.MonkeyPatch) -> None:
    spec = ClassifierSpec(
        name="toy",
        load=lambda network, weights, classes: toy_classifier(),
        origin="",
        licence="",
    )
    monkeypatch.setitem(CLASSIFIERS, "toy", spec)


def poison(folder: Path, names: list[str], kind: str, *more: str) -> dict[str, Any]:
    wanted = names if "noise" not in kind else names[:1]
    assert (
        cli.main(
            [
                "poison",
                *wanted,
                "--kind",
                kind,
                *SMALL[kind],
                *more,
                "--out",
                str(folder),
            ]
        )
        == 0
    )
    record: dict[str, Any] = json.loads((folder / "poison.json").read_text())
    return record


def files(folder: str | Path) -> dict[str, bytes]:
    return {
        file.name: file.read_bytes()
        for file in sorted((Path(folder) / "images").iterdir())
    }


def both(
    names: list[str], folder: Path, split: Any = "train"
) -> tuple[Dataset, Dataset]:
    return load_dataset(names[0], split=split), load_dataset(folder, split=split)


def test_every_kind_is_tried() -> None:
    assert {*kind_names()} == {*SMALL, "cloak"}


@pytest.mark.parametrize("kind", SMALL)
def test_without_a_budget_every_file_keeps_its_bytes(
    kind: str, names: list[str], tmp_path: Path
) -> None:
    record = poison(tmp_path / "out", names, kind, *NONE)
    assert record["changed"] == 0
    assert files(tmp_path / "out") == files(names[0])


@pytest.mark.parametrize("kind", SMALL)
def test_pictures_change_within_the_ball_and_keep_alpha_and_masks(
    kind: str, names: list[str], tmp_path: Path
) -> None:
    record = poison(
        tmp_path / "out", names, kind, "--eps", "8", "--share", "0.5", "--seed", "3"
    )
    assert {"kind": kind, "eps": 8, "seed": 3}.items() <= record.items()
    changes = {change["index"]: change for change in record["changes"]}
    assert len(changes) == 2
    before, after = both(names, tmp_path / "out")
    for index, (old, new) in enumerate(zip(before, after, strict=True)):
        for plane in (Dataset.alpha, Dataset.loss_mask):
            kept = plane(before, index)
            keeps = plane(after, index)
            assert kept is not None
            assert keeps is not None
            assert torch.equal(kept, keeps)
        difference = (old.image - new.image).abs()
        assert (difference[:, :4] == 0).all()  # where it is clear
        told = changes.get(index, {"largest": 0.0, "pixels_changed": 0})
        assert float(difference.max()) == pytest.approx(told["largest"], abs=1e-6)
        assert int((difference.amax(-1) > 0).sum()) == told["pixels_changed"]
        assert told["largest"] <= 8 / 255 + 1e-6
    assert sum(change["pixels_changed"] for change in changes.values()) > 0
    stayed = [f"train_{i:05d}.png" for i in range(4) if i not in changes] + [
        "test_00000.png"
    ]
    clean = files(names[0])
    poisoned_files = files(tmp_path / "out")
    assert all(clean[name] == poisoned_files[name] for name in stayed)
    assert load_picture(tmp_path / "out" / "before_and_after.png").size == (40, 48)


def test_only_the_object_is_misread(names: list[str], tmp_path: Path) -> None:
    record = poison(tmp_path / "out", names, "m-ifgsm", "--eps", "16", "--target", "tv")
    assert (record["label"], record["target"], record["classifier"]) == (
        "car",
        "tv",
        "toy",
    )
    assert 0 < record["gaussians"] < len(SPLAT)
    assert all(
        0 < change["pixels_changed"] < change["pixels"] / 2
        for change in record["changes"]
    )


@pytest.mark.parametrize(
    ("more", "told"),
    [
        (["--kind", "poison-splat"], "arguments: expected SPLAT, got none"),
        (["--kind", "poison-spat"], "did you mean poison-splat?"),
        (
            ["SPLAT", "--kind", "poison-splat", "--through", "blurr"],
            "--through: expected one of blur",
        ),
        (["--kind", "uniform-noise", "--steps", "3"], "got --steps"),
        (
            ["SPLAT", "--kind", "m-ifgsm"],
            "--label: expected the class of the object, got none",
        ),
        (
            ["SPLAT", "--kind", "m-ifgsm", "--classifier", "toy", "--label", "cat"],
            "one of car, bird, tv, got 'cat'",
        ),
        (
            ["SPLAT", "--device", "cuda"],
            "--device cuda: expected --kind poison-splat or m-ifgsm, got cloak",
        ),
    ],
)
def test_what_is_refused(
    more: list[str],
    told: str,
    names: list[str],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    words = [names[1] if word == "SPLAT" else word for word in more]
    assert cli.main(["poison", names[0], *words, "--out", str(tmp_path / "out")]) in (
        1,
        2,
    )
    assert told in " ".join(capsys.readouterr().err.split())
    assert not (tmp_path / "out").exists()


def test_a_gpu_that_is_not_there_is_refused(
    names: list[str],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(variant, "has_cuda", lambda: False)
    for words in (
        ["poison", *names, "--kind", "poison-splat"],
        ["train", names[0]],
        ["dagger", names[1]],
    ):
        assert (
            cli.main([*words, "--device", "cuda", "--out", str(tmp_path / "out")]) == 1
        )
        assert not (tmp_path / "out").exists()
        said = " ".join(capsys.readouterr().err.split())
        assert "expected an NVIDIA GPU that Dr.Jit and torch can use, got none" in said


@pytest.mark.skipif(
    not (variant.has_cuda() and torch.cuda.is_available()), reason="needs a GPU"
)
@pytest.mark.parametrize(
    "more", [("poison-splat",), ("m-ifgsm",), ("m-ifgsm", "--decoy-steps", "3")]
)
def test_a_gpu_makes_nearly_the_same_pictures(
    more: tuple[str, ...], names: list[str], tmp_path: Path
) -> None:
    for device in ("cpu", "cuda"):
        assert (
            poison(tmp_path / device, names, *more, "--eps", "8", "--device", device)[
                "device"
            ]
            == device
        )
    of_cpu, of_gpu = (
        load_dataset(tmp_path / device, split="train") for device in ("cpu", "cuda")
    )
    for one, other in zip(of_cpu, of_gpu, strict=True):
        # signs of gradients near 0 differ
        assert float((one.image - other.image).abs().mean()) < 2 / 255


def test_a_picture_without_the_object_is_named(
    names: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    away = orbit(
        (90.0, 0.0, 0.0),
        count=1,
        elevation=0,
        distance=4.0,
        start=180,
        lens=Lens(focal=24.0, size=(20, 16)),
    )
    write_transforms(
        tmp_path / "set",
        [View(at, torch.full((16, 20, 3), 0.5)) for at in (CAMERAS[0], *away)],
    )
    words = [str(tmp_path / "set"), names[1], "--kind", "m-ifgsm", *SMALL["m-ifgsm"]]
    assert cli.main(["poison", *words, "--out", str(tmp_path / "out")]) == 1
    assert "train_00001.png: expected some pixels of the object" in " ".join(
        capsys.readouterr().err.split()
    )
    assert not (tmp_path / "out").exists()


@dataclass(frozen=True, kw_only=True)
class BlotConfig:
    by: float = 0.5


def blotted(config: BlotConfig, given: Given) -> ImagePoison:
    def change(
        views: Sequence[View], *, seed: int = 0, on_step: OnStep | None = None
    ) -> Poisoned:
        pictures = {}
        for number, view in enumerate(views):
            mask = mask_of(given.masks, number, view.camera)
            pictures[number] = view.image.masked_fill(mask[..., None], config.by)
        return poisoned(views, pictures, {"kind": "blot", "by": config.by})

    return change


def test_a_poison_from_outside_is_given_the_masks_that_it_needs(
    names: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    spec = PoisonSpec(name="blot", config=BlotConfig, make=blotted, needs=("object",))
    monkeypatch.setitem(POISONS.own, "blot", spec)
    words = ["poison", *names, "--kind", "blot", "--by", "1", "--cluster", "1"]
    assert cli.main([*words, "--out", str(tmp_path / "out")]) == 0
    record = json.loads((tmp_path / "out" / "poison.json").read_text())
    assert record["kind"] == "blot"
    before = load_dataset(names[0], split="train")
    after = load_dataset(tmp_path / "out", split="train")
    scene = load_splat(names[1])
    rows = select(scene, Selection(cluster=1))
    render = Renderer(RenderSettings(near=near_plane(scene, before.cameras)))
    for old, new, camera in zip(before, after, before.cameras, strict=True):
        mask = object_weight(scene, rows, camera, render) >= SEEN
        changed = (old.image != new.image).any(2)
        assert bool(changed.any())
        assert not bool((changed & ~mask).any())
    # without an object it cannot begin
    assert cli.main([*words[:-2], "--out", str(tmp_path / "none")]) == 1
