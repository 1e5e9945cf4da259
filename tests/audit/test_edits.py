"""Colours that an attack on a detector leaves are found; gloss, mirrors, stickers and
noise all over a file are not.
"""

from collections.abc import Callable

import pytest
import torch
from torch import Tensor
from torch.nn import functional

from mi_splat.audit.evidence import edit_of
from mi_splat.audit.objects import frame_of, targets
from mi_splat.audit.results import Edit
from mi_splat.maths.sh import sh_basis
from mi_splat.scene import GaussianScene
from tests.audit import scenes
from tests.audit.scenes import Made, direction, standing

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
