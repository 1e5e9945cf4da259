"""A toy object, its views and a quick attack on fakes."""

from typing import Any

from attacks.dagger.attack import attack_views
from attacks.dagger.config import DaggerConfig
from attacks.dagger.result import Result
from attacks.dagger.views import DrawnViews
from attacks.objectives.base import Objective
from attacks.objectives.relabel import relabel
from attacks.transformations.config import (
    CameraRegion,
    ImageTransformations,
    Transformations,
)
from tests.fakes import ColourDetector, blobs, camera, toy_scene

REGION = CameraRegion(
    azimuths=(-120.0, -60.0), elevations=(0.0, 30.0), distances=(0.9, 1.1)
)
QUICK: dict[str, Any] = {
    "optimiser": "momentum",
    "image_psnr": None,
    "eps": (2.0,),
    "steps": 8,
    "step_factor": 4.0,
    "batch": 2,
    "pool": 6,
    "validation": 4,
    "validate_every": 3,
    "held_out": 8,
}


def toy_views(
    images: ImageTransformations | None = None, *, region: CameraRegion = REGION
) -> DrawnViews:
    scene, mask = toy_scene()
    transformations = Transformations(
        cameras=region, images=images or ImageTransformations()
    )
    return DrawnViews(scene, mask, camera(), transformations, render=blobs)


def quick(
    objective: Objective | None = None,
    *,
    views: DrawnViews | None = None,
    **settings: Any,
) -> Result:
    return attack_views(
        views or toy_views(),
        ColourDetector(),
        objective or relabel("person"),
        config=DaggerConfig.for_region(**{**QUICK, **settings}),
    )
