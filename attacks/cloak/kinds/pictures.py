"""The victim's pictures of a scene, as a set that trainings read."""

from __future__ import annotations

import os
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from attacks.cloak import setup
from attacks.cloak.kinds.parts import SET, StepConfig
from mi_splat.capture.settings import CaptureSettings
from mi_splat.capture.writer import write_capture

if TYPE_CHECKING:
    from mi_splat.ledger import Out

VARIES = (f"{SET}/capture.json",)


def run(config: StepConfig, inputs: Mapping[str, Path], out: Out) -> None:
    """Take them; they are transparent where nothing is, so that the background has no part in them."""
    study = config.study(inputs)
    mesh_scene = setup.mesh_scene_of(study)
    write_capture(
        setup.capture_source(study, mesh_scene),
        setup.training_cameras(study, mesh_scene.target),
        out.partial / SET,
        settings=CaptureSettings(samples=study.cameras.samples, rgba=True, points=study.cameras.points),
        on_step=partial(out.progress, "taking the victim's pictures"),
    )
    os.replace(out.partial / SET, out / SET)
