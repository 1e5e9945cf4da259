"""M-IFGSM on a tiny classifier: what it reaches, and what it leaves alone."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from attacks.classifiers.frozen import classified
from attacks.poisons.base import ImagePoison
from attacks.poisons.config import FilterConfig, MIFGSMConfig
from attacks.poisons.defences import filtered
from attacks.poisons.mifgsm import MIFGSM
from attacks.poisons.poison_splat import Decoy
from mi_splat.cameras.camera import Camera, View
from mi_splat.cameras.lens import Lens
from mi_splat.cameras.sets import orbit
from mi_splat.errors import InvalidValueError
from mi_splat.io.images import to_bytes
from tests.classifiers.made import CLASSES, SIZE, toy_classifier
from tests.gaussians import varied_scene

CAMERAS = orbit(
    (0.0, 0.0, 0.0),
    count=3,
    elevation=20.0,
    distance=4.0,
    lens=Lens(focal=24.0, size=(40, 32)),
)
CLASSIFIER = toy_classifier()
ANY = MIFGSMConfig(least_confidence=0.0)


def mask_of(camera: Camera) -> Tensor:
    mask = torch.zeros(camera.height, camera.width, dtype=torch.bool)
    mask[6:28, 5:36] = True
    return mask


@pytest.fixture(scope="module")
def views() -> list[View]:
    torch.set_num_threads(1)
    coarse = torch.rand(3, 3, 4, 5, generator=torch.Generator().manual_seed(4))
    noise = (
        torch.nn.functional.interpolate(coarse, (32, 40), mode="bilinear")
        .permute(0, 2, 3, 1)
        .contiguous()
    )
    return [
        View(camera, (image * 255).round() / 255)
        for camera, image in zip(CAMERAS, noise, strict=True)
    ]


def attack(config: MIFGSMConfig = ANY, label: str = "car", **more: Any) -> MIFGSM:
    return MIFGSM(
        config=config, classifier=CLASSIFIER, label=label, **{"masks": mask_of, **more}
    )


def confidences(views: Any, label: str) -> list[float]:
    return [
        row["confidence"]
        for row in classified(CLASSIFIER, [view.image for view in views], label)
    ]


@pytest.mark.parametrize("paste", ["resized", "difference", "direct"])
@pytest.mark.parametrize("eps", [None, 8])
def test_the_true_class_is_less_sure_inside_the_ball_and_the_mask(
    views: list[View], paste: Any, eps: Any
) -> None:
    poison: ImagePoison = attack(replace(ANY, paste=paste, eps=eps))
    done = poison(views)
    for before, after in zip(
        confidences(views, "car"), confidences(done.views, "car"), strict=True
    ):
        assert after < 0.8 * before
    most = 255 if eps is None and paste == "resized" else 43 if eps is None else eps
    for index, view in enumerate(views):
        mask = mask_of(view.camera)
        picture = done.views[index].image
        assert torch.equal(picture[~mask], view.image[~mask])
        moved = np.abs(
            to_bytes(picture).astype(int) - to_bytes(view.image).astype(int)
        ).max()
        assert 0 < moved <= most
        assert torch.equal((picture * 255).round() / 255, picture)
    assert done.manifest["changed"] == 3
    assert (done.manifest["kind"], done.manifest["classifier"]) == ("m-ifgsm", "toy")


def test_a_target_becomes_surer(views: list[View]) -> None:
    done = attack(replace(ANY, target="tv", eps=16))(views)
    for before, after in zip(
        confidences(views, "tv"), confidences(done.views, "tv"), strict=True
    ):
        assert after > 1.2 * before


def test_steps_at_the_size_of_the_classifier_are_those_of_a_loop(
    views: list[View],
) -> None:
    """One image of the classifier's own size: nothing is scaled."""
    (camera,) = orbit(
        (0, 0, 0),
        count=1,
        elevation=0,
        distance=4,
        lens=Lens(focal=24, size=(SIZE, SIZE)),
    )
    view = View(camera, torch.rand(SIZE, SIZE, 3))
    config = replace(ANY, steps=3, deviation=(0.1, 0.2, 0.3))
    done = attack(config, masks=None)([view])
    wanted = view.image.double()
    for _ in range(3):
        wanted.requires_grad_(True)
        (slope,) = torch.autograd.grad(
            -torch.log_softmax(CLASSIFIER.scores(wanted[None]), 1)[0, 0], wanted
        )
        wanted = (
            wanted.detach() + 0.02 * torch.tensor([0.1, 0.2, 0.3]) * slope.sign()
        ).clamp(0, 1)
    assert (done.views[0].image - wanted).abs().max() < 0.51 / 255


def test_what_is_found_through_a_blur_is_there_after_it(views: list[View]) -> None:
    blur = FilterConfig(name="blur", strength=1.5)

    def left(through: FilterConfig | None) -> float:
        done = attack(replace(ANY, paste="direct", eps=16, through=through))(views)
        return sum(
            confidences(
                [View(view.camera, filtered(view.image, blur)) for view in done.views],
                "car",
            )
        )

    assert left(blur) < 0.95 * left(None)


def test_a_decoy_changes_all_cameras_alike() -> None:
    """The victim gets the image of one splat, which is misread, inside the mask and
    the ball.
    """
    splat = varied_scene(30, degree=1, seed=9)
    cameras = CAMERAS[:2]
    decoy = Decoy(start=splat, near=0.1)
    views = [
        View(camera, (decoy.picture(splat, camera).clamp(0, 1) * 255).round() / 255)
        for camera in cameras
    ]
    poison = attack(
        replace(ANY, steps=3, paste="direct", eps=24, decoy_steps=130), decoy=decoy
    )
    done = poison(views, seed=1)
    for before, after in zip(
        confidences(views, "car"), confidences(done.views, "car"), strict=True
    ):
        assert after < 0.9 * before
    for index, view in enumerate(views):
        mask = mask_of(view.camera)
        picture = done.views[index].image
        assert torch.equal(picture[~mask], view.image[~mask])
        assert 0 < (picture - view.image).abs().max() < 24.01 / 255
    again = [view.image for view in poison(views, seed=1).views]
    assert all(
        torch.equal(view.image, other)
        for view, other in zip(done.views, again, strict=True)
    )


def test_what_leaves_the_set_as_it_is(views: list[View]) -> None:
    for config in (replace(ANY, eps=0), replace(ANY, share=0.0)):
        done = attack(config)(views)
        assert done.manifest["changed"] == 0
        assert all(done.views[i] is views[i] for i in range(3))
    unsure = attack(replace(ANY, least_confidence=1.0))(views)
    assert unsure.manifest["skipped"] == [0, 1, 2]
    assert unsure.manifest["changed"] == 0


def test_bad_input(views: list[View]) -> None:
    with pytest.raises(
        InvalidValueError,
        match="label of toy: expected one of car, bird, tv, got 'zebra'",
    ):
        attack(label="zebra")(views)
    with pytest.raises(InvalidValueError, match="target of toy: expected one of"):
        attack(replace(ANY, target="zebra"))(views)
    with pytest.raises(InvalidValueError, match="target: expected another class"):
        attack(replace(ANY, target=CLASSES[0]))(views)
    empty = [mask_of(camera) & (number != 1) for number, camera in enumerate(CAMERAS)]
    with pytest.raises(
        InvalidValueError,
        match="mask of view 1: expected some pixels of the object, got none",
    ):
        attack(masks=empty)(views)
    with pytest.raises(
        InvalidValueError, match="masks: expected one for each of 3 views"
    ):
        attack(masks=empty[:2])(views)
    with pytest.raises(
        InvalidValueError,
        match="decoy: expected one if it shall take steps, got 5 steps of a decoy",
    ):
        attack(replace(ANY, decoy_steps=5))(views)
