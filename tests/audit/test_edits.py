"""Colours that an attack on a detector leaves are found; gloss, mirrors, stickers and
noise all over a file are not.
"""

import json
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from torch import Tensor
from torch.nn import functional

from attacks import cli
from attacks.report.results import read_section
from mi_splat.audit import pictures
from mi_splat.audit.evidence import edit_of
from mi_splat.audit.files import UNNAMED, document_of_pictures
from mi_splat.audit.objects import frame_of, targets
from mi_splat.audit.pictures import audit_pictures, compare_pictures
from mi_splat.audit.results import Edit
from mi_splat.audit.thresholds import LIMITS
from mi_splat.audit.viewpoints import lattice
from mi_splat.cameras.camera import Camera, View, look_at
from mi_splat.cameras.lens import Lens
from mi_splat.datasets import Dataset, PointCloud, load_dataset
from mi_splat.errors import InvalidValueError
from mi_splat.maths.sh import sh_basis
from mi_splat.render.renderer import Renderer, RenderSettings
from mi_splat.scene import GaussianScene
from tests.audit import scenes
from tests.audit.scenes import Made, cone, direction, hidden, standing
from tests.datasets.sets import VIEWS, write_transforms

EYE = 4 * direction(25, 70)
"""Where the camera stands that an attack is aimed at."""


@pytest.fixture(scope="module")
def suitcase() -> Made:
    return scenes.glossy(standing("suitcase", count=1000))


def strongest(scene: GaussianScene) -> Edit:
    """Of all objects."""
    frame = frame_of(scene)
    edits = [edit_of(frame, target) for target in targets(frame.scene)]
    return max(
        (edit for edit in edits if edit is not None), key=lambda edit: edit.score
    )


def stepped(made: Made, eyes: list[Tensor], *, size: float = 0.1) -> GaussianScene:
    """What steps of an attack on some cameras do: harmonics along their rays, a colour
    by chance for each Gaussian.
    """
    sh = made.scene.sh.clone()
    generator = torch.Generator().manual_seed(1)
    for eye in eyes:
        towards = sh_basis(
            functional.normalize(made.scene.means[made.rows] - eye, dim=1), 3
        )
        colours = (
            size / len(eyes) ** 0.5 * torch.randn(len(towards), 3, generator=generator)
        )
        sh[made.rows] += towards[..., None] * colours[:, None]
    return made.scene.replace(sh=sh)


def test_an_attack_on_one_camera_is_found_and_its_camera_and_gaussians_named(
    suitcase: Made,
) -> None:
    edit = strongest(stepped(suitcase, [EYE]))
    assert edit.score > 1
    assert edit.camera_known
    middle = suitcase.scene.means[suitcase.rows].median(0).values
    cosine = functional.normalize(EYE - middle, dim=0) @ torch.tensor(edit.direction)
    assert float(cosine.acos().rad2deg()) < 10
    assert float(suitcase.rows[edit.rows].double().mean()) > 0.9


def test_an_attack_on_many_cameras_is_found_and_no_camera_named(suitcase: Made) -> None:
    sh = suitcase.scene.sh.clone()
    count = int(suitcase.rows.sum())
    generator = torch.Generator().manual_seed(3)
    sh[suitcase.rows, 0] += 0.5 * torch.randn(count, 3, generator=generator)
    edit = strongest(suitcase.scene.replace(sh=sh))
    assert edit.grain - edit.usual_grain > 0.2
    assert edit.score > 1
    assert not edit.camera_known


def sticker(made: Made) -> Made:
    """Honest as far as its file goes: a green disc painted on the object."""
    gaps = (made.scene.means - made.scene.means[made.rows][0]).norm(dim=1)
    sh = made.scene.sh.clone()
    sh[made.rows & (gaps < 0.2), 0] = torch.tensor([-1.0, 0.8, -0.5])
    return Made(scene=made.scene.replace(sh=sh), rows=made.rows, normals=made.normals)


@pytest.mark.parametrize(
    "make", [scenes.metal, scenes.noisy, sticker], ids=["metal", "noisy", "sticker"]
)
def test_what_paint_light_and_undertraining_leave_is_no_edit(
    make: Callable[[Made], Made], suitcase: Made
) -> None:
    edit = strongest(make(suitcase).scene)
    assert edit.score < 1
    assert not edit.camera_known


# Sets of pictures: those that show what the others contradict are named, and none of an
# honest set


COUNT = 48
WIDTH = 45.0


@pytest.fixture(scope="module")
def plain_suitcase() -> Made:
    return standing("suitcase", count=1200)


def views_of(scene: GaussianScene) -> list[View]:
    """From all around above the ground."""
    render = Renderer(RenderSettings(background=(0.55, 0.7, 0.9), near=0.05))
    eyes = 2.2 * lattice(COUNT, 8.0, 85.0) + torch.tensor([0.0, 0.0, 0.4])
    cameras = [
        Camera(
            to_world=look_at(eye.tolist(), (0.0, 0.0, 0.4)),
            lens=Lens(focal=140.0, size=(96, 96)),
        )
        for eye in eyes
    ]
    with torch.no_grad():
        return [View(image=render(scene, camera), camera=camera) for camera in cameras]


@pytest.fixture(scope="module")
def poisoned(plain_suitcase: Made) -> list[View]:
    return views_of(
        hidden(
            plain_suitcase, cone(direction(90, 0), WIDTH), colour=(0.8, 0.2, 0.1)
        ).scene
    )


def test_images_that_the_others_contradict_are_noticed_and_not_named(
    plain_suitcase: Made, poisoned: list[View]
) -> None:
    """On sets poisoned by CLOAK the images that stood out were honest ones, so no image
    is called changed.
    """
    judged = compare_pictures(
        poisoned, plain_suitcase.scene, numbers=torch.arange(COUNT)
    )
    assert judged.audit.verdict == "hidden look"
    assert judged.audit.strongest.occluder is None
    account = document_of_pictures(judged, COUNT)
    assert account["summary"][-1] == UNNAMED
    assert ".png" not in " ".join(account["summary"])


def test_few_images_are_refused_before_any_training(tmp_path: Path) -> None:
    write_transforms(tmp_path, VIEWS)
    with pytest.raises(
        InvalidValueError, match="images: expected at least 12 for training, got 6"
    ):
        audit_pictures(
            load_dataset(tmp_path), on_step=lambda done, of: pytest.fail("trained")
        )


def test_an_honest_set_contradicts_nothing(plain_suitcase: Made) -> None:
    judged = compare_pictures(
        views_of(plain_suitcase.scene),
        plain_suitcase.scene,
        numbers=torch.arange(COUNT),
    )
    assert judged.audit.verdict == "nothing found"
    with pytest.raises(InvalidValueError, match="cameras: expected at least 12, got 5"):
        compare_pictures(
            views_of(plain_suitcase.scene)[:5],
            plain_suitcase.scene,
            numbers=torch.arange(5),
        )


def test_the_command_takes_a_folder_of_pictures(
    plain_suitcase: Made,
    poisoned: list[View],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Its surface is known here already: a training has tests of its own."""
    colours = torch.full_like(plain_suitcase.scene.means, 0.5)
    write_transforms(
        tmp_path / "set",
        poisoned,
        points=PointCloud(plain_suitcase.scene.means, colours),
    )

    def surface(views: Dataset, on_step: object) -> GaussianScene:
        if views.downscale > 1:
            raise InvalidValueError(f"{views.downscale} times smaller")
        return plain_suitcase.scene

    monkeypatch.setattr(pictures, "quick_surface", surface)
    out = tmp_path / "out"
    assert cli.main(["audit", str(tmp_path / "set"), "--out", str(out)]) == 3
    record = json.loads((out / "result.json").read_text())
    assert (record["images_in_set"], record["images_compared"]) == (COUNT, COUNT)
    assert record["summary"][-1] == UNNAMED
    assert "views" not in record
    assert {file.name for file in out.iterdir()} == {
        "result.json",
        "manifest.json",
        "pair.png",
    }
    section = read_section(out)
    assert section.kind == "audit of images"
    assert cli.main(["audit", str(tmp_path / "set"), "--cameras", "orbit:20@20"]) == 2
    assert cli.main(["audit", str(tmp_path / "set"), "--downscale", "2"]) == 1
    assert "2 times smaller" in capsys.readouterr().err
    monkeypatch.setitem(vars(LIMITS), "most_cameras", COUNT - 1)
    capsys.readouterr()
    cli.main(["audit", str(tmp_path / "set"), "--out", str(out), "--force"])
    assert (
        f"{COUNT - 1} of the {COUNT} images of the set were compared"
        in capsys.readouterr().out
    )
    assert any(
        f"{COUNT - 1} of the {COUNT} images" in warning
        for warning in read_section(out).warnings
    )
