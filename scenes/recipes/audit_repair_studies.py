"""What a repair brings back of splats that CLOAK attacked:
`python -m scenes.recipes.audit_repair_studies FILE.csv STUDY ...`.

Each STUDY is a folder that `mi-splat cloak` wrote. Its attacked splat is audited and
repaired without a cone, and the study's held-out cameras count from where detectors
report its object: well inside each trigger, and far outside of all of them. Beside
FILE.csv, an image of each STUDY shows clean, attacked and repaired splat from the
middle of its triggers.
"""

import json
import sys
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from functools import cached_property, partial
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from attacks import load_detector
from attacks.audits.recognition import Recognition
from attacks.cloak.config import StudyConfig, recorded_study
from attacks.cloak.setup import Setup
from attacks.detectors.base import Detector
from attacks.observe.observations import report_cells
from mi_splat import GaussianScene, load_splat
from mi_splat.audit import Audit, audit, repaired
from mi_splat.cameras.camera import Camera
from mi_splat.io.images import save_picture, side_by_side
from mi_splat.maths.metrics import psnr
from scenes.recipes.audit_repair import write

DETECTORS = ("fasterrcnn_small", "yolov8n_small")
ELSEWHERE = "elsewhere"


@dataclass(frozen=True, kw_only=True)
class Row:
    """From how many cameras of a kind a detector reports the object."""

    study: str
    seed: int
    splat: str
    detector: str
    answer: str  # of the audit
    where: str  # name of a trigger, or elsewhere
    found: int
    cameras: int
    psnr: str  # mean of the PSNR to the clean splat, dB; empty for the clean one


@dataclass(frozen=True, kw_only=True, eq=False)
class Judged:
    """A study, and those of its held-out cameras that count."""

    study: StudyConfig

    @cached_property
    def setup(self) -> Setup:
        """Its scene and cameras."""
        return Setup.of(self.study)

    @cached_property
    def cameras(self) -> list[tuple[str, Camera]]:
        """Where each camera stands, a trigger or elsewhere, and the camera."""
        evaluation = self.study.evaluation
        cones = {attack.name: attack.cone for attack in self.study.attack}
        found = list[tuple[str, Camera]]()
        for camera in self.setup.held_out_cameras:
            depths = {
                name: cone.angle_to_edge(camera, centre=self.setup.centre)
                for name, cone in cones.items()
            }
            deepest = max(depths, key=depths.__getitem__)
            if depths[deepest] >= evaluation.well_inside:
                found.append((deepest, camera))
            elif depths[deepest] <= -evaluation.far_outside:
                found.append((ELSEWHERE, camera))
        return sorted(found, key=lambda item: item[0])

    @property
    def groups(self) -> dict[str, list[int]]:
        """Numbers of the cameras of each kind."""
        found: dict[str, list[int]] = {}
        for number, (name, _) in enumerate(self.cameras):
            found.setdefault(name, []).append(number)
        return found

    def images(self, splat: GaussianScene) -> list[Tensor]:
        """What each camera sees."""
        render = self.setup.renderer()
        with torch.no_grad():
            return [render(splat, camera).clamp(0, 1) for _, camera in self.cameras]

    def reports(self, detector: Detector, images: list[Tensor]) -> Tensor:
        """(K,) bool, from which cameras a detector reports the object."""
        label = self.study.scene.class_name
        least = self.study.evaluation.confidence
        seen = []
        for image, (_, camera) in zip(images, self.cameras, strict=True):
            (found,) = detector.detect(image[None])
            cells = report_cells(found, self.setup.box(camera), original=label)
            seen.append(float(cells["original_score"] or 0) >= least)
        return torch.tensor(seen)


def rows_of(
    judged: Judged,
    splat: str,
    answer: str,
    images: list[Tensor],
    clean: list[Tensor],
) -> Iterator[Row]:
    """The rows of a splat."""
    likeness = [float(psnr(*pair)) for pair in zip(images, clean, strict=True)]
    for kind in DETECTORS:
        seen = judged.reports(load_detector(kind), images)
        for where, numbers in judged.groups.items():
            mean = float(np.mean([likeness[number] for number in numbers]))
            yield Row(
                study=judged.study.name,
                seed=judged.study.seeds[0],
                splat=splat,
                detector=kind,
                answer=answer,
                where=where,
                found=int(seen[numbers].sum()),
                cameras=len(numbers),
                psnr=f"{mean:.1f}" if np.isfinite(mean) else "",
            )


def measured(folder: Path, image: Path) -> Iterator[Row]:
    """The rows of clean, attacked and repaired splat of a study."""
    record = json.loads((folder / "result.json").read_text())
    judged = Judged(study=recorded_study(record["study"], "study"))
    clean = load_splat(folder / "clean.ply")
    attacked = load_splat(folder / "cloaked.ply")
    again = partial(audit, recogniser=Recognition())
    found: Audit = again(attacked)
    done = repaired(attacked, found, again)
    splats = {
        "clean": (clean, again(clean).answer),
        "attacked": (attacked, found.answer),
        "repaired": (done.scene, done.audit.answer),
    }
    of_clean = judged.images(clean)
    shown = list[Tensor]()
    for name, (splat, answer) in splats.items():
        images = judged.images(splat)
        yield from rows_of(judged, name, answer, images, of_clean)
        inside = [numbers[len(numbers) // 2] for numbers in judged.groups.values()]
        shown.append(torch.cat([images[number] for number in inside]))
    save_picture(side_by_side(shown), image)


def main(file: str, *folders: str) -> None:
    """Audit and repair the splats of each study, and compare them with the clean."""
    rows = list[Row]()
    for folder in map(Path, folders):
        rows += measured(folder, Path(file).with_name(f"{folder.name}.png"))
        write(Path(file), list(map(asdict, rows)))


if __name__ == "__main__":
    main(*sys.argv[1:])
