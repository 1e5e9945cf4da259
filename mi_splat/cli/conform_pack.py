"""The conformance pack: small splats in several formats, their cameras, and for each
the exact image and its gradients.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import numpy as np

from mi_splat.cameras.lens import Lens
from mi_splat.conformance.comparison import as_meant
from mi_splat.conformance.deviations import PROFILES
from mi_splat.conformance.gradients import exact_gradients
from mi_splat.conformance.scenes import ConformanceScene
from mi_splat.conformance.setups import Setup
from mi_splat.conformance.tolerances import difference, least_tolerance, tolerance_of
from mi_splat.oracle import PinholeCamera, Splat

if TYPE_CHECKING:
    from mi_splat.cameras.camera import Camera
    from mi_splat.scene import GaussianScene

Scenes = Mapping[str, ConformanceScene]
_PAGE = Path(__file__).parent / "conformance"
"""The page that drives a web viewer, and what the pack says of itself."""
_FAR = 1000.0


@dataclass(frozen=True, kw_only=True)
class PackSettings:
    """What a pack holds."""

    size: int  # pixels on each side
    profile: str
    formats: tuple[str, ...]


def write_inputs(scenes: Scenes, folder: Path, formats: tuple[str, ...]) -> None:
    """Write what is rendered, and the page that drives a web viewer."""
    from mi_splat.io.documents import save_text

    (folder / "splats").mkdir(parents=True)
    for name, scene in scenes.items():
        _write_splat(scene, folder / "splats" / name, formats)
    _write_cameras(scenes, folder)
    for file in _PAGE.iterdir():
        if file.is_file():
            save_text(file.read_text(), folder / file.name)


def write_pack(
    scenes: Scenes,
    folder: Path,
    settings: PackSettings,
    advance: Callable[[str], None],
) -> dict[str, Any]:
    """Write splats, cameras, reference images and gradients into an empty folder.

    Returns:
        What is written into its result.json, too.
    """
    from mi_splat.io.documents import save_json

    write_inputs(scenes, folder, settings.formats)
    (folder / "images").mkdir()
    (folder / "gradients").mkdir()
    rows = []
    for name, scene in scenes.items():
        advance(name)
        meant = as_meant(scene.setup, settings.profile)
        _write_reference(meant, folder / "images" / name)
        if settings.profile != "ray":
            _write_gradients(scene.setup, folder / "gradients" / f"{name}.npz")
        rows.append(
            {
                "name": name,
                "fact": scene.fact,
                "tolerance": tolerance_of(meant, 8)._asdict(),
                "rounding": _roundings(scene, settings),
            }
        )
    document = {
        "story": "conformance",
        "size": settings.size,
        "profile": settings.profile,
        "differences_of_profile": PROFILES[settings.profile],
        "formats": list(settings.formats),
        "tolerance_of_floats": least_tolerance(32)._asdict(),
        "scenes": rows,
    }
    save_json(document, folder / "result.json")
    return document


def _roundings(scene: ConformanceScene, settings: PackSettings) -> dict[str, Any]:
    """By format how far the image is off of what the format keeps of a splat."""
    exact, _ = as_meant(scene.setup, settings.profile).render()
    found = {}
    for suffix in settings.formats:
        if suffix != ".ply":
            kept, _ = as_meant(as_read(scene, suffix), settings.profile).render()
            error = difference(kept, exact)
            found[suffix] = {"psnr": error.psnr, "largest": error.largest}
    return found


# ---------------------------------------------------------------------------- splats


def _write_splat(scene: ConformanceScene, path: Path, formats: tuple[str, ...]) -> None:
    """Write a splat in every format; the PLY has the stored values to the bit."""
    from plyfile import PlyData, PlyElement

    from mi_splat.io.splat_files import write_splat_file

    rows = _ply_rows(scene)
    ply = path.with_name(f"{path.name}.ply")
    PlyData([PlyElement.describe(rows, "vertex")], byte_order="<").write(str(ply))
    splat = load(ply)
    for suffix in formats:
        if suffix not in (".ply", ".glb"):
            write_splat_file(splat, path.with_name(path.name + suffix))
    if ".glb" in formats or scene.file in ("moved by a node", "wrong COLOR_0"):
        _write_gltf(splat, scene, path.with_name(f"{path.name}.glb"))
    if ".ply" not in formats:
        ply.unlink()


def _ply_rows(scene: ConformanceScene) -> np.ndarray[Any, Any]:
    from mi_splat.io.ply import rest_names

    stored = scene.setup.stored
    rest = stored.sh[:, 1:].transpose(0, 2, 1).reshape(len(stored.sh), -1)
    columns = dict(zip("xyz", stored.means.T, strict=True))
    columns |= {f"f_dc_{i}": stored.sh[:, 0, i] for i in range(3)}
    columns |= dict(zip(rest_names(rest.shape[1]), rest.T, strict=True))
    columns |= {"opacity": stored.opacities}
    columns |= {f"scale_{i}": column for i, column in enumerate(stored.scales.T)}
    columns |= {f"rot_{i}": column for i, column in enumerate(stored.rotations.T)}
    if scene.file == "other columns":
        more = {
            "label": np.zeros(len(rest), dtype=np.uint8),
            **dict.fromkeys(("nx", "ny", "nz"), np.ones(len(rest))),
        }
        columns = more | dict(reversed(columns.items()))
    types = [(name, "u1" if name == "label" else "<f4") for name in columns]
    rows = np.empty(len(rest), dtype=types)
    for name, column in columns.items():
        rows[name] = column
    return rows


def through_file(scene: ConformanceScene, suffix: str) -> GaussianScene:
    """What is read of a splat in a format."""
    with TemporaryDirectory() as folder:
        _write_splat(scene, Path(folder) / "splat", (suffix,))
        return load(Path(folder) / f"splat{suffix}")


def load(path: Path) -> GaussianScene:
    """A splat without its broken Gaussians."""
    import warnings

    from mi_splat.io import load_splat
    from mi_splat.io.errors import SplatFileWarning

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", SplatFileWarning)
        return load_splat(path, on_invalid="drop")


def as_read(scene: ConformanceScene, suffix: str) -> Setup:
    """The setup with what a format keeps of its splat."""
    if suffix == ".ply":
        return scene.setup
    tensors = through_file(scene, suffix).tensors()
    values = Splat(*(tensor.numpy().astype(np.float64) for tensor in tensors))
    opacities = np.clip(values.opacities, 1e-9, 1 - 1e-9)
    stored = values._replace(
        scales=np.log(np.maximum(values.scales, 1e-30)),
        opacities=np.log(opacities / (1 - opacities)),
    )
    return replace(scene.setup, stored=stored)


# ------------------------------------------------------------------------------ glTF


def _write_gltf(splat: GaussianScene, scene: ConformanceScene, path: Path) -> None:
    """Write a glTF with the camera, and with a node that puts its splat where it is in
    other files, or with a wrong COLOR_0.
    """
    import torch

    from mi_splat.io.splat_files import write_splat_file
    from mi_splat.scene import Similarity

    moved = scene.file == "moved by a node"
    if moved:
        turn = torch.tensor([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
        splat = splat.transform(
            Similarity(turn.T, turn.T @ torch.tensor([-3.0, 1.0, -4.0]), 2.0)
        )
    write_splat_file(splat, path)
    content = path.read_bytes()
    start = 28 + int.from_bytes(content[12:16], "little")
    document = json.loads(content[20 : start - 8])
    if moved:  # the axes x and y of glTF point against those of a PLY
        turn_back = [-(0.5**0.5), 0, 0, 0.5**0.5]
        document["nodes"][0] |= {
            "translation": [-1.5, 0.5, 2.0],
            "rotation": turn_back,
            "scale": [0.5] * 3,
        }
    if scene.file == "wrong COLOR_0":
        attributes = document["meshes"][0]["primitives"][0]["attributes"]
        # the bytes of the positions
        document["accessors"][attributes["COLOR_0"]]["bufferView"] = 0
    _add_gltf_camera(document, scene.setup.camera)
    _save_gltf(document, content[start - 8 :], path)


def _add_gltf_camera(document: dict[str, Any], view: PinholeCamera) -> None:
    """Add a camera, unless its principal point is off the centre, which glTF cannot
    say.
    """
    if (view.cx, view.cy) != (view.width / 2, view.height / 2):
        return
    half = view.height / (2 * view.fy)
    document["cameras"] = [
        {
            "type": "perspective",
            "perspective": {
                "yfov": 2 * float(np.arctan(half)),
                "aspectRatio": view.width / (2 * view.fx) / half,
                "znear": 0.2,
            },
        }
    ]
    # from the axes of a PLY to those of glTF, and from OpenCV's camera to OpenGL's
    pose = np.diag([-1.0, -1, 1, 1]) @ view.to_world @ np.diag([1.0, -1, -1, 1])
    document["nodes"].append(
        {"camera": 0, "matrix": pose.T.ravel().tolist(), "name": "camera"}
    )
    document["scenes"][0]["nodes"].append(len(document["nodes"]) - 1)


def _save_gltf(document: dict[str, Any], rest: bytes, path: Path) -> None:
    """Write a GLB with another JSON before its binary chunk."""
    from mi_splat.io.documents import save_bytes

    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    length = 20 + len(text) + len(rest)
    head = struct.pack("<4s4I", b"glTF", 2, length, len(text), 0x4E4F534A)
    save_bytes(head + text + rest, path)


# ------------------------------------------------------------------------ references


def _write_reference(setup: Setup, path: Path) -> None:
    """Write an image as PNG and as EXR."""
    import torch

    from mi_splat.io.documents import save_png
    from mi_splat.io.images import to_bytes
    from mi_splat.render.renderer import save_floats

    image, alpha = setup.render()
    save_png(to_bytes(torch.from_numpy(image)), path.with_name(f"{path.name}.png"))
    red, green, blue = np.moveaxis(image, 2, 0).astype(np.float32)
    planes = {"R": red, "G": green, "B": blue, "A": alpha.astype(np.float32)}
    save_floats(planes, path.with_name(f"{path.name}.exr"))


def _write_gradients(setup: Setup, path: Path) -> None:
    found: dict[str, Any] = {
        key: values.astype(np.float32) for key, values in exact_gradients(setup).items()
    }
    with path.open("wb") as file:
        np.savez_compressed(file, **found)


def _write_cameras(scenes: Scenes, folder: Path) -> None:
    from mi_splat.datasets.writing import list_colmap, list_transforms
    from mi_splat.io.camera_records import describe
    from mi_splat.io.documents import save_json

    cameras = {name: camera_of(scene.setup.camera) for name, scene in scenes.items()}
    records = [
        {
            **describe(name, camera),
            **_opengl(scenes[name].setup.camera),
            "background": scenes[name].setup.background,
        }
        for name, camera in cameras.items()
    ]
    save_json({"near": 0.2, "cameras": records}, folder / "cameras.json")
    listing = {"train": [(f"{name}.png", camera) for name, camera in cameras.items()]}
    list_transforms(folder, listing, None)
    list_colmap(folder, listing, None)


def camera_of(view: PinholeCamera) -> Camera:
    """The camera of a scene for the renderers of mi-splat."""
    import torch

    from mi_splat.cameras.camera import Camera

    return Camera(
        to_world=torch.from_numpy(view.to_world),
        lens=Lens(
            focal=(view.fx, view.fy),
            size=(view.width, view.height),
            principal=(view.cx, view.cy),
        ),
    )


def _opengl(view: PinholeCamera) -> dict[str, list[float]]:
    """View and projection matrices of OpenGL, column by column."""
    near = 0.2
    depth = _FAR - near
    projection = np.zeros((4, 4))
    projection[0, 0] = 2 * view.fx / view.width
    projection[0, 2] = 1 - 2 * view.cx / view.width
    projection[1, 1] = 2 * view.fy / view.height
    projection[1, 2] = 2 * view.cy / view.height - 1
    projection[2, 2] = -(_FAR + near) / depth
    projection[2, 3] = -2 * _FAR * near / depth
    projection[3, 2] = -1
    inverse = np.linalg.inv(view.to_world @ np.diag([1.0, -1.0, -1.0, 1.0]))
    return {
        "gl_view": inverse.T.ravel().tolist(),
        "gl_projection": projection.T.ravel().tolist(),
    }
