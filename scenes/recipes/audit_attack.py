"""An attacker who differentiates through the audit's prediction:
`python -m scenes.recipes.audit_attack FOLDER FILE.csv`.

The attacked splat is the car of `docs/examples/06_cloak_in_the_file.py`, which has to
be run first. Its spherical harmonics are optimised so that each cone of directions
looks like what the other directions predict for it, while the car stays hidden from
above and visible elsewhere. Each row is a weight of that aim against the other one, and
a detector.
"""

import csv
import sys
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path

import torch
from torch import Tensor
from torch.nn import functional

from attacks.audits.recognition import Recognition
from mi_splat import GaussianScene
from mi_splat.audit import HeldOutConfig, audit
from mi_splat.audit.auditing import looks_at
from mi_splat.audit.held_out import Consensus, cones_around
from mi_splat.audit.objects import frame_of
from scenes.recipes.audit_repair import Case, cases, images_of, rows_of

WEIGHTS = (0.0, 0.3)
STEPS = 120
RATE = 0.02
DISTANCE = 0.15  # below which features count as alike
GAIN = 0.4  # the same of the gain of confidence


@dataclass(frozen=True, kw_only=True)
class Row:
    """What an attacked splat still hides, and what the audit says of it."""

    weight: float  # of agreement with the predictions, by that of the images
    detector: str
    answer: str
    evidence: float
    inside: int  # images from above in which the detector reports the car
    of_inside: int
    elsewhere: int
    of_elsewhere: int


def evaded(case: Case, weight: float, recogniser: Recognition) -> GaussianScene:
    """The attacked splat, changed so that its cones of directions agree."""
    config = HeldOutConfig(shown=3)
    frame = frame_of(case.attacked)
    target, stands = looks_at(frame, None, config)[0]
    consensus = Consensus(frame, target, stands[: config.cameras], config)
    chosen = {
        cone: numbers
        for cone in cones_around(target.up)
        if (numbers := consensus.chosen(cone))
    }
    wanted = consensus.images(consensus.scene, range(len(consensus.cameras)))
    (label,) = [n for n, name in enumerate(recogniser.classes) if name == case.label]
    fixed = consensus.scene
    sh = fixed.sh.clone().requires_grad_()
    optimiser = torch.optim.Adam([sh], lr=RATE)
    generator = torch.Generator().manual_seed(0)
    cones = list(chosen)
    for _ in range(STEPS):
        cone = cones[int(torch.randint(len(cones), (), generator=generator))]
        numbers = chosen[cone]
        consensus.scene = GaussianScene.unchecked(*fixed.tensors()[:4], sh)
        shown = consensus.rendered(consensus.scene, numbers)
        predicted = consensus.predicted(cone.holds(consensus.directions))
        kept = (shown - wanted[numbers]).abs().mean()
        loss = 10 * kept
        for scene in (predicted.painted, predicted.peeled):
            image = consensus.rendered(scene, numbers)
            loss = loss + weight * _contradiction(recogniser, shown, image, label)
        optimiser.zero_grad()
        torch.autograd.backward(loss)
        if sh.grad is not None:
            sh.grad[~consensus.own] = 0
        optimiser.step()
    changed = case.attacked.sh.clone()
    changed[consensus.rows] = consensus.world_sh(sh.detach())
    return GaussianScene.unchecked(*case.attacked.tensors()[:4], changed)


def _contradiction(
    recogniser: Recognition, shown: Tensor, image: Tensor, label: int
) -> Tensor:
    """How far an image of a prediction is beyond what the audit lets pass."""
    described = [
        functional.normalize(recogniser.described(images), dim=1)
        for images in (shown, image)
    ]
    distance = 1 - (described[0] * described[1]).sum(1).mean()
    scores = [
        recogniser.confidences(images)[:, label].mean() for images in (shown, image)
    ]
    beyond = (distance - DISTANCE).clamp(min=0) / DISTANCE
    return beyond + (scores[1] - scores[0] - GAIN).clamp(min=0) / GAIN


def rows(case: Case, weight: float, recogniser: Recognition) -> Iterator[Row]:
    """The rows of a weight."""
    splat = case.attacked
    if weight:
        splat = evaded(case, weight, recogniser)
    found = audit(splat, recogniser)
    images, inside = images_of(case, splat)
    for row in rows_of(case, "attacked", images, inside, found.answer):
        yield Row(
            weight=weight,
            detector=row.detector,
            answer=row.answer,
            evidence=round(found.evidence, 3),
            inside=row.inside,
            of_inside=row.of_inside,
            elsewhere=row.elsewhere,
            of_elsewhere=row.of_elsewhere,
        )


def main(folder: str, file: str) -> None:
    """Attack with each weight, and count."""
    case = next(cases(Path(folder)))
    of = partial(rows, case, recogniser=Recognition())
    with Path(file).open("w", newline="") as stream:
        writer = csv.DictWriter(stream, Row.__annotations__, lineterminator="\n")
        writer.writeheader()
        for weight in WEIGHTS:
            writer.writerows(map(asdict, of(weight)))
            stream.flush()


if __name__ == "__main__":
    main(*sys.argv[1:])
