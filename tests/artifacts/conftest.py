"""A small study of CLOAK as it lies on the disk when it is finished, without the hours before, and its artifact."""

from __future__ import annotations

import json
import shutil
from dataclasses import asdict, replace
from pathlib import Path

import pytest
import torch

from attacks.artifacts.packing import pack_artifact
from attacks.cloak import setup
from attacks.cloak.observations import Blend, Fidelity, ObservedSplat, StudyRows, observation_of
from attacks.cloak.rates import figures
from attacks.cloak.study import dependencies
from attacks.cloak.study.cache import content_of
from attacks.cloak.study.trained_splats import TrainedSplat
from attacks.observe.views import detect_views
from mi_splat import provenance
from mi_splat.io import load_splat, save_splat
from mi_splat.rendering import Renderer, RenderSettings
from mi_splat.scene import GaussianScene, scene_hash
from mi_splat.sh import colour_to_dc
from tests.cloak.tiny_study import STUDY as TINY
from tests.cloak.tiny_study import Redness

STUDY = replace(TINY, evaluation=replace(TINY.evaluation, cameras=40))
PAGE = "docs/page.md"


def thing(colour: tuple[float, float, float]) -> GaussianScene:
    """A cloud of one colour where the study's object stands."""
    generator = torch.Generator().manual_seed(0)
    count = 60
    return GaussianScene(
        means=torch.randn(count, 3, generator=generator) * torch.tensor([0.8, 0.5, 0.3]) + torch.tensor([0, 0, 0.7]),
        scales=torch.full((count, 3), 0.25),
        rotations=torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(count, 1),
        opacities=torch.full((count,), 0.9),
        sh=colour_to_dc(torch.tensor(colour).expand(count, 1, 3)),
    )


def observed(trained: TrainedSplat) -> ObservedSplat:
    """What a study would have seen of a splat; the comparisons with true pictures are made up."""
    target = setup.target_of(STUDY.scene)
    cameras = setup.held_out_cameras(STUDY, target)
    settings = RenderSettings(background=STUDY.scene.background, near=setup.near_of(STUDY, target))
    boxes = [setup.box_of(target, camera) for camera in cameras]
    seen = detect_views(trained.load(), cameras, [Redness()], render=Renderer(settings), boxes=boxes)
    loss = 0.1 if trained.splat == "clean" else 1 / 3
    return ObservedSplat(
        trained=trained,
        observations=tuple(observation_of(STUDY, one) for one in seen),
        fidelities=tuple(Fidelity(view=i, elevation=i / 7, psnr=30.0 - loss * i, ssim=0.9) for i in (1, 2)),
        blends=tuple(
            Blend(
                meridian=0,
                elevation=20.0 * i,
                depth=20.0 * i - 38.2,
                fraction=min(1.0, i / 3) if trained.splat == "cloaked" else 0.0,
                surroundings_psnr=33.0 - loss,
                appearance_psnr=20.0 + loss,
            )
            for i in range(5)
        ),
    )


@pytest.fixture(scope="session")
def result(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of the finished study; its stages are in it."""
    folder = tmp_path_factory.mktemp("finished") / "study"
    (folder / "stages").mkdir(parents=True)
    splats = []
    for name, colour in (("clean", (0.9, 0.1, 0.1)), ("cloaked", (0.5, 0.4, 0.4))):
        path = folder / f"{name}.ply"
        save_splat(thing(colour), path)
        scene = load_splat(path)
        trained = TrainedSplat(
            splat=name, seed=0, file=path, content=f"{name} content", gaussians=len(scene), hash=scene_hash(scene)
        )
        splats.append(observed(trained))
        stage = folder / "stages" / f"observations-{name}"
        stage.mkdir()
        lists = {key: getattr(splats[-1], key) for key in ("observations", "fidelities", "blends")}
        text = json.dumps({key: [asdict(one) for one in values] for key, values in lists.items()})
        (stage / "observations.json").write_text(text)
        depends_on = dependencies.of_observations(
            STUDY, "source", trained.content, ["true"], {"redness": Redness.fingerprint}
        )
        done = {"depends_on": depends_on, "content": content_of(stage, ("**/*",))}
        (stage / "done.json").write_text(json.dumps(done))
    listed = [{key: value for key, value in asdict(item.trained).items() if key != "file"} for item in splats]
    summary = {
        **figures(STUDY, StudyRows.of(splats)),
        "files": [],
        "splats": listed,
        "detectors": {"redness": Redness.fingerprint},
        "seeds": [0],
        "study": asdict(STUDY),
        "versions": provenance.versions(),
        "commit": None,
        "variant": "llvm_ad_rgb",
        "seconds": 1.0,
    }
    (folder / "summary.json").write_text(json.dumps(summary))
    return folder


@pytest.fixture(scope="session")
def packed(result: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The artifact of the study, which no test changes."""
    out = tmp_path_factory.mktemp("packed") / "artifact"
    pack_artifact(result, out, pages=[PAGE], splats=True, detectors=[Redness()])
    return out


@pytest.fixture
def artifact(packed: Path, tmp_path: Path) -> Path:
    """A copy of the artifact, for a test to break."""
    shutil.copytree(packed, tmp_path / "artifact")
    return tmp_path / "artifact"
