"""Every kind of file that is read: a small valid one, and what reads it."""

import dataclasses
import importlib.util
import json
import os
import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image
from safetensors.torch import save_file

from attacks.cloak.config import read_study
from attacks.dagger import search as eot_checkpoint
from attacks.dagger.search import ImagePrice
from attacks.detectors.weights import apply_weights, read_weights
from attacks.observe.rows import frame_of, packed, read_rows, rows_bytes
from attacks.report.checking import check_result, read_result
from attacks.report.results import RESULT_KINDS, kind_of, read_section
from attacks.search import START, SearchState, Step
from attacks.studies import study_file
from mi_splat.capture.mesh_files import gltf_notes
from mi_splat.capture.writer import claim_folder
from mi_splat.datasets.frames import read_mask, read_picture
from mi_splat.datasets.transforms import read_cameras, read_world_offset
from mi_splat.errors import MiSplatError
from mi_splat.io.camera_records import describe, recorded_cameras
from mi_splat.io.points import load_points
from mi_splat.io.splat_files import load_splat, save_splat
from mi_splat.scene_files import open_scene
from mi_splat.selection.select import load_mask, save_mask
from mi_splat.training.loop import Progress, TrainState
from mi_splat.training.resume import load_state, save_state
from mi_splat.training.strategies import FixedConfig
from tests.fakes import camera
from tests.fuzz.folders import clean, links, plan_with_keys, write_among_links
from tests.fuzz.mutations import CHECKPOINT, GLB, PLAIN_JSON, SAFETENSORS, SCENE_NAMES, SOG, Document
from tests.io.format_files import tame_scene, valid
from tests.io.ply_files import LISTS, ROWS, encoded, listed
from tests.io.test_picture_files import many_scans
from tests.report.results import MAKERS
from tests.training.sets import SHORT, scene_and_views

ROOT = Path(__file__).resolve().parents[2]


@dataclass(frozen=True, slots=True, kw_only=True)
class Kind:
    """A kind of file: `make` writes a valid one with what belongs to it, and `read` reads it as the commands do.

    `document` says where it has JSON; None if it has none.
    """

    make: Callable[[Path], Path]
    read: Callable[[Path], object]
    document: Document | None = None


def _splat(name: str) -> Kind:
    def make(folder: Path) -> Path:
        (folder / name).write_bytes(valid(name))
        return folder / name

    document = {"a.glb": GLB, "a.sog": SOG}.get(name)
    return Kind(make=make, read=load_splat, document=document)


def _written(name: str, content: Callable[[], Any]) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        values = content()
        (folder / name).write_bytes(values if isinstance(values, bytes) else json.dumps(values).encode())
        return folder / name

    return make


def _copied(*names: str) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        for name in names:
            shutil.copy(ROOT / name, folder)
        return folder / Path(names[0]).name

    return make


def _transforms() -> dict[str, Any]:
    pose = [[1, 0, 0, 0], [0, 0, -1, -3], [0, 1, 0, 0.5], [0, 0, 0, 1]]
    frames = [{"file_path": f"images/{n}.png", "transform_matrix": pose, "k1": 0} for n in range(2)]
    return {"camera_angle_x": 0.7, "w": 64, "h": 48, "world_offset": [1, 2, 3.5], "frames": frames}


def _camera_files(path: Path) -> None:
    if recorded_cameras(path) is None:
        read_cameras(path, (64, 48))
        read_world_offset(path)


_CAPTURE = {"version": "1", "scene": "a", "cameras": "b", "train": 3, "test": 1, "samples": 16, "seed": 0}
_CAPTURE |= {"alpha": True, "points": 0, "near": None, "pictures": 1, "mitsuba": "3", "world_offset": [0, 0, 0]}
_CAPTURE |= {"inputs": {"scene": {"object": "car"}, "cameras": {"count": 3}}}


def _weights(name: str, folder: Path) -> Path:
    state = torch.nn.Linear(3, 2).state_dict()
    (save_file if name.endswith(".safetensors") else torch.save)(state, folder / name)
    return folder / name


def _training(folder: Path) -> Path:
    _, _, start = scene_and_views(4)
    config = dataclasses.replace(SHORT, iterations=9, sh_degree=0, strategy=FixedConfig())
    state = TrainState(start, config, scene_extent=1.0, seed=5)
    state.iteration, state.view_queue, state.settings = 4, [2, 0], {"near": 0.1}
    state.history = [Progress(iteration=2, loss=0.5, count=4)]
    for name in state.trained:
        moments = {key: torch.zeros_like(state.parameters[name]) for key in ("exp_avg", "exp_avg_sq")}
        state.optimiser.state[state.parameters[name]] = {**moments, "step": torch.ones(())}
    save_state(state, folder / "state.safetensors")
    return folder / "state.safetensors"


def _search(folder: Path) -> Path:
    line = Step(index=0, loss=1.0, score=0.5, success=False, unambiguous=False, zero_gradient_fraction=0.0)
    point = {"means": torch.zeros(2, 3)}
    price = ImagePrice.of(35.0, steps=8)
    search = SearchState(point=point, optimiser=START, best=point, best_line=line, trace=(line,))
    kept = eot_checkpoint.KeptSearch(search=search, price=price, seconds=1.0)
    eot_checkpoint.save_state(kept, folder / "s.checkpoint", key="key")
    return folder / "s.checkpoint"


def _result(name: str) -> Kind:
    """A result that a page can show."""

    def make(folder: Path) -> Path:
        record = next(story.file for story in RESULT_KINDS if story.name == name)
        return MAKERS[name](folder / "result") / record

    return Kind(make=make, read=lambda path: read_section(path.parent), document=PLAIN_JSON)


def _check(folder: Path) -> None:
    result = read_result(folder)
    check_result(result, kind_of(result).figures)


def _artifact(file: str) -> Kind:
    def make(folder: Path) -> Path:
        shutil.copytree(ROOT / "docs/artifacts/transfer_views", folder / "artifact")
        return next((folder / "artifact").glob(file))

    document = PLAIN_JSON if file.endswith(".json") else None
    return Kind(make=make, read=lambda path: _check(path.parent), document=document)


def _mask(folder: Path) -> Path:
    save_mask(torch.arange(20) % 3 == 0, folder / "m.npy")
    return folder / "m.npy"


def _picture(name: str, folder: Path) -> Path:
    pixels = np.arange(16 * 12 * 3, dtype=np.uint8).reshape(12, 16, 3)
    Image.fromarray(pixels).save(folder / name)
    return folder / name


def _scans(folder: Path) -> Path:
    (folder / "p.jpg").write_bytes(many_scans(90))
    return folder / "p.jpg"


def _rows(name: str, folder: Path) -> Path:
    more = {f"depth: {number}": 1.0 for number in range(190 if name.startswith("wide") else 0)}
    data = rows_bytes(frame_of({"view": view, "splat": "clean", "iou": 0.5 / (view + 1), **more} for view in range(20)))
    (folder / name).write_bytes(packed(data) if name.endswith(".xz") else data)
    return folder / name


def _see(path: Path) -> None:
    read_picture(path, downscale=1, background=(0.0, 0.0, 0.0))
    read_mask(path, downscale=1)


def _ply(folder: Path) -> Path:
    save_splat(tame_scene(5, 1), folder / "a.ply")
    return folder / "a.ply"


_SPLATS: tuple[str, ...] = ("a.compressed.ply", "a.glb", "a.sog", "a.splat", "v2.spz", "v3.spz", "v4.spz")
_SPLATS += ("a.usdc", "a.usda") if importlib.util.find_spec("pxr") else ()
_PLY_FORMS = {"text.ply": encoded(ROWS[:5], "ascii")}
_PLY_FORMS["lists.ply"] = listed("binary_little_endian", ROWS[:5], LISTS[:5])
_KSPLATS = sorted(path.name.removesuffix(".gz") for path in (ROOT / "tests/io/data").glob("*.ksplat.gz"))


def _kinds() -> Iterator[tuple[str, Kind]]:
    for name in (*_SPLATS, *_KSPLATS[:1]):
        yield f"splat {name}", _splat(name)
    yield "splat a.ply", Kind(make=_ply, read=load_splat)
    for name in _PLY_FORMS:
        yield f"splat {name}", Kind(make=_written(name, partial(_PLY_FORMS.get, name)), read=load_splat)
    yield "points", Kind(make=_ply, read=load_points)
    cameras: dict[str, Callable[[], Any]] = {
        "cameras.json": lambda: [describe("left", camera())],
        "transforms.json": _transforms,
        "result.json": lambda: {"views": [{"camera": describe("a", camera())}], "cameras": ["left"]},
    }
    for name, content in cameras.items():
        yield f"cameras {name}", Kind(make=_written(name, content), read=_camera_files, document=PLAIN_JSON)
    capture = _written("capture.json", lambda: _CAPTURE)
    claim = Kind(make=capture, read=lambda path: claim_folder(path.parent, dict(_CAPTURE)), document=PLAIN_JSON)
    yield "record of a capture", claim
    for name in ("w.safetensors", "w.pth"):
        document = SAFETENSORS if name.endswith("tensors") else None
        yield f"weights {name}", Kind(make=partial(_weights, name), read=_apply, document=document)
    yield "training", Kind(make=_training, read=load_state, document=CHECKPOINT)
    yield "search", Kind(make=_search, read=partial(eot_checkpoint.load_state, key="key"), document=CHECKPOINT)
    for name in MAKERS:
        yield f"result {name}", _result(name)
    yield "result.json of an artifact", _artifact("result.json")
    yield "manifest.json", _artifact("manifest.json")
    yield "table of an artifact", _artifact("*.csv*")
    for name in ("rows.csv", "rows.csv.xz", "wide.csv.xz"):
        yield f"rows {name}", Kind(make=partial(_rows, name), read=read_rows)
    yield "study", Kind(make=_copied("scenes/cloak_demo.toml"), read=read_study)
    yield "study of attacks", Kind(make=_copied("scenes/studies/transfer.toml"), read=_plan)
    gltf = _written("a.gltf", lambda: GLB.get(valid("a.glb")))
    yield "mesh a.gltf", Kind(make=gltf, read=gltf_notes, document=PLAIN_JSON)
    yield "mask", Kind(make=_mask, read=lambda path: load_mask(path, tame_scene(20, 1)))
    yield from ((f"picture {name}", Kind(make=partial(_picture, name), read=_see)) for name in ("p.png", "p.jpg"))
    yield "picture of JPEG scans", Kind(make=_scans, read=_see)
    yield "keys", Kind(make=plan_with_keys, read=clean, document=PLAIN_JSON)
    yield "links", Kind(make=links, read=write_among_links, document=PLAIN_JSON)
    parts = (".xml", ".json", "_roadside.ply", "_stop_sign.ply")
    yield "scene XML", Kind(make=_copied(*(f"scenes/stop_sign{part}" for part in parts)), read=open_scene)
    yield "names in a scene XML", Kind(make=_beside_code_and_pipe, read=_open_without_code, document=SCENE_NAMES)


def _beside_code_and_pipe(folder: Path) -> Path:
    path = _copied(*(f"scenes/stop_sign{part}" for part in (".xml", "_roadside.ply", "_stop_sign.ply")))(folder)
    os.mkfifo(folder / "pipe")
    (folder / "plugins").mkdir()
    for name in ("evil.so", "plugins/evil.so"):
        (folder / name).write_text("no library: Mitsuba says so if it tries to load it")
    return path


def _open_without_code(path: Path) -> None:
    """Open a scene; that Mitsuba tried to load code beside it is a failure."""
    try:
        open_scene(path)
    except MiSplatError as error:
        if "loading plugin" in str(error):
            raise AssertionError(str(error)) from error
        raise


def _plan(path: Path) -> None:
    """Everything that a study file says, down to the settings of each of its jobs."""
    study_file.read_study(path)


def _apply(path: Path) -> None:
    apply_weights(torch.nn.Linear(3, 2), read_weights(path), path)


EVERY = dict(_kinds())
