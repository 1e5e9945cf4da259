"""The victim's pictures of a scene, as a set that trainings read."""

from __future__ import annotations

import os
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from attacks.cloak.kinds.parts import SET, SceneJob
from mi_splat.capture.settings import CaptureSettings
from mi_splat.capture.writer import write_capture

if TYPE_CHECKING:
    from mi_splat.ledger import Out

VARIES = (f"{SET}/capture.json",)


def run(config: SceneJob, inputs: Mapping[str, Path], out: Out) -> None:
    """Take the pictures; they are transparent where nothing is, so that the background has no part in them."""
    setup = config.setup(inputs)
    write_capture(
        setup.source,
        setup.training_cameras,
        out.partial / SET,
        settings=CaptureSettings(samples=setup.cameras.samples, rgba=True, points=setup.cameras.points),
        on_step=partial(out.progress, "taking the victim's pictures"),
    )
    os.replace(out.partial / SET, out / SET)
