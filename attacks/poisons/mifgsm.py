"""M-IFGSM: training images in which an object is changed so that a classifier
misreads it, and with them the splat.

Zeybey, Ergezen and Nguyen, "Gaussian Splatting Under Attack", arXiv 2412.02803: the
masked iterative fast gradient sign method. Of each image on its own, the pixels of
the object are moved by steps of one length along the sign of the gradient of the
cross-entropy of its true class, which rises. Nothing holds the images of different
cameras together, unless a decoy does, which is new here: a splat that learns the
changed images. The victim gets the decoy's own.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass

import torch
from torch import Tensor
from torch.nn.functional import adaptive_max_pool2d, cross_entropy, interpolate

from attacks.classifiers.base import Classifier
from attacks.classifiers.frozen import class_number
from attacks.poisons.base import (
    Masks,
    OnStep,
    Poisoned,
    ball,
    check_masks,
    chosen_views,
    mask_of,
    poisoned,
    sign_steps,
    within_ball,
)
from attacks.poisons.config import MIFGSMConfig
from attacks.poisons.defences import filtered
from attacks.poisons.poison_splat import Decoy
from mi_splat.cameras.camera import View
from mi_splat.errors import InvalidValueError
from mi_splat.scene import GaussianScene


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MIFGSM:
    """M-IFGSM as a poison.

    Steps are taken at the classifier's resolution, as published: the image is scaled
    so that its shorter side is the classifier's `size`, and what was found is scaled
    back (`MIFGSMConfig.paste` says how). The result is rounded to 8 bits inside the
    mask; outside, not a bit differs.
    """

    config: MIFGSMConfig
    classifier: Classifier
    label: str
    masks: Masks | None = None  # where the object is; None is everywhere
    decoy: Decoy | None = None  # where a decoy begins; None is without one

    def __call__(
        self, views: Sequence[View], *, seed: int = 0, on_step: OnStep | None = None
    ) -> Poisoned:
        """The set with the chosen images changed, but for those that the classifier
        misreads already.
        """
        config = self.config
        true = class_number(self.classifier, self.label, "label")
        if config.target is None:
            goal = true
        else:
            goal = class_number(self.classifier, config.target, "target")
        if config.target == self.label:
            raise InvalidValueError.of(
                "target", "another class than the label", self.label, "choose another"
            )
        if (self.decoy is None) != (config.decoy_steps == 0):
            got = (
                f"{config.decoy_steps} steps of a decoy"
                f" {'without' if self.decoy is None else 'beside'} one"
            )
            raise InvalidValueError.of(
                "decoy",
                "one if it shall take steps",
                got,
                "pass one, or no decoy_steps",
            )
        check_masks(self.masks, len(views))
        chosen = chosen_views(views, config.share, seed) if config.eps != 0 else []
        masks = {index: self._mask(index, views[index]) for index in chosen}
        unsure = config.least_confidence
        skipped = [
            index
            for index in chosen
            if self._confidence(views[index].image, true) < unsure
        ]
        pictures = {
            index: views[index].image for index in chosen if index not in skipped
        }
        if self.decoy is not None and pictures:
            decoy = self._learned(self.decoy, views, masks, goal, seed, on_step)
            for index, clean in pictures.items():
                own = within_ball(
                    self.decoy.picture(decoy, views[index].camera), clean, config.eps
                )
                pictures[index] = torch.where(masks[index], own.to(clean), clean)
        else:
            for number, (index, clean) in enumerate(pictures.items(), start=1):
                pictures[index] = self._changed(clean, clean, masks[index], goal)
                if on_step is not None:
                    on_step(number, len(pictures))
        about = {
            "kind": "m-ifgsm",
            "label": self.label,
            "seed": seed,
            **asdict(config),
            "skipped": skipped,
        }
        who = {
            "classifier": self.classifier.name,
            "fingerprint": self.classifier.fingerprint,
        }
        return poisoned(views, pictures, {**about, **who})

    def _mask(self, index: int, view: View) -> Tensor:
        mask = mask_of(self.masks, index, view.camera)
        if not mask.any():
            do = "leave the view out, or correct the mask"
            raise InvalidValueError.of(
                f"mask of view {index}", "some pixels of the object", "none", do
            )
        return mask[..., None].to(view.image.device)

    def _learned(
        self,
        decoy: Decoy,
        views: Sequence[View],
        masks: Mapping[int, Tensor],
        goal: int,
        seed: int,
        on_step: OnStep | None,
    ) -> GaussianScene:
        """The decoy after its steps; it learns the clean image where nothing is to
        change.
        """

        def target(image: Tensor, index: int) -> Tensor:
            clean = views[index].image.to(image.device)
            if index not in masks:
                return clean
            return self._changed(
                image.detach().clamp(0, 1), clean, masks[index].to(image.device), goal
            )

        return decoy.learn(
            views, target, steps=self.config.decoy_steps, seed=seed, on_step=on_step
        )

    def _confidence(self, picture: Tensor, number: int) -> float:
        with torch.no_grad():
            return float(
                torch.softmax(self.classifier.scores(picture[None])[0].double(), 0)[
                    number
                ]
            )

    def _changed(self, begin: Tensor, clean: Tensor, mask: Tensor, goal: int) -> Tensor:
        """(H, W, 3) image in which the object is misread, from an image to begin
        with.
        """
        paste = self.config.paste
        full = (clean.shape[0], clean.shape[1])
        scale = 1.0 if paste == "direct" else self.classifier.size / min(full)
        size = (max(1, round(full[0] * scale)), max(1, round(full[1] * scale)))
        start = _scaled(begin, size)
        changed = self._steps(
            start,
            _scaled(clean, size),
            adaptive_max_pool2d(mask[None, ..., 0].float(), size)[0, ..., None],
            goal,
        )
        if paste == "difference":
            changed = begin + _scaled(changed - start, full)
        return torch.where(
            mask, within_ball(_scaled(changed, full), clean, self.config.eps), clean
        )

    def _steps(self, start: Tensor, clean: Tensor, mask: Tensor, goal: int) -> Tensor:
        """The iterated steps, (h, w, 3) in [0, 1] and in the ball around the clean one,
        inside the mask (h, w, 1).
        """
        config = self.config
        step = (
            config.step
            * start.new_tensor(config.deviation)
            * mask
            * (1 if config.target is None else -1)
        )
        number = torch.tensor([goal], device=start.device)

        def loss(picture: Tensor) -> Tensor:
            if config.through is None:
                seen = picture
            else:
                seen = filtered(picture, config.through)
            # in 64 bits, for a confidence that rounds to 1 has no gradient
            return cross_entropy(
                self.classifier.scores(seen[None]).to(number.device).double(), number
            )

        return sign_steps(
            start, ball(clean, config.eps), loss, steps=config.steps, step=step
        )


def _scaled(picture: Tensor, size: tuple[int, int]) -> Tensor:
    """(h, w, 3) to another size; between the lowest and the highest value of its
    neighbours.
    """
    if tuple(picture.shape[:2]) == size:
        return picture
    planes = interpolate(
        picture.permute(2, 0, 1)[None], size=size, mode="bilinear", antialias=True
    )
    return planes[0].permute(1, 2, 0)
