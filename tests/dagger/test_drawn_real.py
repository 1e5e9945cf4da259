"""DAGGER over distributions of views with the real renderer and the shipped detector, small."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest

from attacks.dagger.attack import attack_views
from attacks.dagger.config import EotConfig
from attacks.dagger.views import ViewDistribution
from attacks.detectors import load_detector
from attacks.objectives import relabel
from attacks.transformations.config import CameraRegion, Transformations
from mi_splat.rendering import Renderer
from mi_splat.scene_files import read_scene

SCENE = Path(__file__).resolve().parents[2] / "scenes" / "car_street.xml"


@pytest.mark.slow
def test_the_shipped_car_becomes_a_person_from_cameras_that_were_not_attacked() -> None:
    loaded = read_scene(SCENE)
    front = next(iter(loaded.cameras.values()))
    small = dataclasses.replace(front, width=128, height=128, focal=front.fx / 2)
    region = CameraRegion(azimuths=(-10.0, 10.0), elevations=(5.0, 15.0), distances=(1.0, 1.0))
    views = ViewDistribution(
        loaded.scene,
        loaded.objects["car"],
        small,
        Transformations(cameras=region),
        render=Renderer(loaded.settings),
    )
    config = EotConfig(
        steps=14, step_factor=4.0, image_psnr=None, batch=2, pool=14, validation=2, validate_every=7, held_out=6
    )
    found = attack_views(views, load_detector("fasterrcnn_small"), relabel("person"), config=config)
    assert found.rate.successes >= 4
    assert found.rates["noise_success"].successes == found.rates["clean_success"].successes == 0
