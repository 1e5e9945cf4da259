"""`mi-splat conform`: whether a renderer or a converter of others does what 3D Gaussian
Splatting defines.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from mi_splat.cameras.lens import Lens
from mi_splat.cli.console import UsageError, progress, show_result, warn
from mi_splat.cli.flags import Positional
from mi_splat.cli.options import JsonOptions
from mi_splat.errors import InvalidValueError
from mi_splat.fields import Metavar, OutFolder

if TYPE_CHECKING:
    from mi_splat.cameras.camera import Camera
    from mi_splat.conformance import Cause, Setup
    from mi_splat.conformance_scenes import ConformanceScene
    from mi_splat.oracle import Array, PinholeCamera
    from mi_splat.scene import GaussianScene

EXAMPLES = (
    "conform --list",
    "conform --export out/conformance",
    "conform YOUR_IMAGES",
    "conform YOUR_IMAGES --format .spz --out out/report",
    "conform YOUR_IMAGES --browser adapter.js",
    "conform --read YOUR_CONVERTED_FILES",
    "conform --gradients YOUR_GRADIENTS",
)
DIFFERS = 3
"""Exit status where something does not conform."""
_PSNR = {8: 39.0, 32: 80.0}
_LARGEST = {8: 0.06, 32: 1e-3}
"""Least PSNR, dB, and largest difference of a channel at which an image conforms, by
its bits; viewers that blend in 8 bits reach 39 to 50 dB.
"""
_VERDICTS = "differs", "conforms"
_GRADIENT = 1e-3
"""Largest error of a gradient as a part of its length."""
_GRADIENT_FLOOR = 1e-3
"""Least length that an error is divided by, as a part of the length of the scene's
longest gradient: where the exact gradient is 0 (rotations of isotropic Gaussians),
rounding alone is left.
"""
_CHANGE = 2e-4
"""Largest change of a value in a converted file, besides three times that by which our
writer of the format rounds.
"""
_PATIENCE = 600.0
"""Seconds that a viewer may take for all images."""
_BROWSERS = "chromium", "chromium-browser", "google-chrome"
_SWITCHES = (
    "--headless",
    "--no-sandbox",
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
)


@dataclass(frozen=True, kw_only=True)
class ConformOptions(JsonOptions):
    """Test a renderer against the definition of 3D Gaussian Splatting, and name what it
    does differently.

    --export writes small splats, cameras, and for each the exact image and its
    gradients. Render every splat from its camera, save the images as NAME.png or
    NAME.exr (with the values of the PNG, not linear ones), and pass their folder: each
    is compared with the reference, and the likely causes of differences are found by
    fitting. The exit status is 3 if something differs.
    """

    images: Positional[Path | None] = None
    """Folder with the images of a renderer, called as the splats."""
    list: bool = False
    """List the splats and what each shows."""
    export: Annotated[OutFolder | None, Metavar("FOLDER")] = None
    """Write splats, cameras, reference images and gradients into a new folder."""
    read: Path | None = None
    """Folder with the splats in another format: compare their values with those
    exported.
    """
    gradients: Path | None = None
    """Folder with the gradients of a renderer as NAME.npz, called and shaped as those
    exported, to compare them.
    """
    browser: Annotated[Path | None, Metavar("ADAPTER.JS")] = None
    """JavaScript module that draws splats with a web viewer (see viewer.html): make the
    images first, in Chromium.
    """
    formats: tuple[str, ...] = (".ply",)
    """Formats to export, for instance .ply .spz .sog .glb .splat."""
    format: str = ".ply"
    """Format that was rendered; what it cannot hold is not counted as an error."""
    size: Literal[64, 256, 512] = 64
    """Pixels on each side."""
    model: Literal["tile", "ray"] = "tile"
    """Reference: tile is the rasterised image of 3DGS; ray evaluates each Gaussian
    where it is densest along a ray.
    """
    out: OutFolder | None = None
    """Folder for a page with the images that differ, a table and result.json; nothing
    is written without it.
    """
    force: bool = False
    """Replace an older result in --out or --export."""


def run(options: ConformOptions) -> int:
    """List, export or compare."""
    from mi_splat.conformance_scenes import conformance_scenes
    from mi_splat.io.folders import check_new_folder

    given = options.images, options.export, options.read, options.gradients
    tasks = [options.list, *(path is not None for path in given)]
    if sum(tasks) != 1:
        raise UsageError(
            "expected one of a folder of images, --list, --export, --read and"
            " --gradients; pass only one"
        )
    if options.out is not None:
        check_new_folder(options.out, force=options.force)
    every = {scene.name: scene for scene in conformance_scenes(options.size)}
    if options.list:
        document = {
            "scenes": [
                {"name": name, "fact": scene.fact} for name, scene in every.items()
            ]
        }
        show_result(
            document,
            *(f"{name:18}{scene.fact}" for name, scene in every.items()),
            as_json=options.json,
        )
        return 0
    if options.export is not None:
        pack = {
            "out": str(options.export),
            **_write_pack(options, options.export, every),
        }
        show_result(
            pack,
            f"{options.export}: {len(every)} splats with references",
            as_json=options.json,
        )
        return 0
    if options.read is not None:
        return _compare_values(options, options.read, every)
    if options.gradients is not None:
        return _compare_gradients(options, options.gradients, every)
    if options.browser is not None:
        _draw_in_browser(options, options.browser, every)
    return _compare_images(options, every)


# ------------------------------------------------------------------------------- export


def _write_inputs(
    every: Mapping[str, ConformanceScene], folder: Path, formats: tuple[str, ...]
) -> None:
    """What is rendered, and the page that drives a web viewer."""
    from mi_splat.io.documents import save_text

    (folder / "splats").mkdir(parents=True)
    for name, scene in every.items():
        _write_splat(scene, folder / "splats" / name, formats)
    _write_cameras(every, folder)
    for file in (Path(__file__).parent / "conformance").iterdir():
        save_text(file.read_text(), folder / file.name)


def _write_pack(
    options: ConformOptions, out: Path, every: Mapping[str, ConformanceScene]
) -> dict[str, Any]:
    from mi_splat.io.documents import save_json
    from mi_splat.io.folders import new_folder

    with (
        progress("writing", len(every)) as advance,
        new_folder(out, force=options.force) as folder,
    ):
        _write_inputs(every, folder, options.formats)
        for part in ("images", "gradients"):
            (folder / part).mkdir()
        rows = list[dict[str, Any]]()
        for name, scene in every.items():
            advance(name)
            _write_reference(name, scene, options.model, folder)
            exact = _reference(scene.setup, options.model)[0]
            kept = {
                suffix: _as_read(scene, suffix)
                for suffix in options.formats
                if suffix != ".ply"
            }
            rounding = {
                key: _distance(_reference(read, options.model)[0], exact, 8)
                for key, read in kept.items()
            }
            rows.append({"name": name, "fact": scene.fact, "rounding": rounding})
        settings = {
            "size": options.size,
            "model": options.model,
            "formats": list(options.formats),
        }
        tolerances = {
            bits: {"least_psnr": _PSNR[bits], "largest": _LARGEST[bits]}
            for bits in _PSNR
        }
        document = {
            "story": "conformance",
            **settings,
            "tolerances_by_bits": tolerances,
            "scenes": rows,
        }
        save_json(document, folder / "result.json")
    return document


def _write_splat(scene: ConformanceScene, path: Path, formats: tuple[str, ...]) -> None:
    """Write a splat in every format; the PLY has the stored values to the bit."""
    import numpy as np
    from plyfile import PlyData, PlyElement

    from mi_splat.io.ply import rest_names
    from mi_splat.io.splat_files import write_splat_file

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
    rows = np.empty(
        len(rest),
        dtype=[(name, "u1" if name == "label" else "<f4") for name in columns],
    )
    for name, column in columns.items():
        rows[name] = column
    ply = path.with_name(f"{path.name}.ply")
    PlyData([PlyElement.describe(rows, "vertex")], byte_order="<").write(str(ply))
    splat = _load(ply)
    for suffix in formats:
        if suffix != ".ply":
            write_splat_file(splat, path.with_name(path.name + suffix))
    if scene.file in ("moved by a node", "wrong COLOR_0"):
        _write_gltf(
            splat,
            path.with_name(f"{path.name}.glb"),
            moved=scene.file == "moved by a node",
        )
    if ".ply" not in formats:
        ply.unlink()


def _through_file(scene: ConformanceScene, suffix: str) -> GaussianScene:
    """What is read of a splat in a format."""
    from tempfile import TemporaryDirectory

    with TemporaryDirectory() as folder:
        _write_splat(scene, Path(folder) / "splat", (suffix,))
        return _load(Path(folder) / f"splat{suffix}")


def _load(path: Path) -> GaussianScene:
    """A splat without its broken Gaussians."""
    import warnings

    from mi_splat.io import load_splat
    from mi_splat.io.errors import SplatFileWarning

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", SplatFileWarning)
        return load_splat(path, on_invalid="drop")


def _write_gltf(splat: GaussianScene, path: Path, *, moved: bool) -> None:
    """A glTF with a node that puts its splat where it is in other files, or with a
    wrong COLOR_0.
    """
    import torch

    from mi_splat.io.documents import save_bytes
    from mi_splat.io.splat_files import write_splat_file
    from mi_splat.scene import Similarity

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
    else:
        attributes = document["meshes"][0]["primitives"][0]["attributes"]
        # the bytes of the positions
        document["accessors"][attributes["COLOR_0"]]["bufferView"] = 0
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    rest = content[start - 8 :]
    head = struct.pack(
        "<4s4I", b"glTF", 2, 20 + len(text) + len(rest), len(text), 0x4E4F534A
    )
    save_bytes(head + text + rest, path)


def _write_reference(
    name: str, scene: ConformanceScene, model: str, folder: Path
) -> None:
    import numpy as np
    import torch

    from mi_splat.io.documents import save_png
    from mi_splat.io.images import to_bytes
    from mi_splat.render.renderer import save_floats

    image, alpha = _reference(scene.setup, model)
    save_png(to_bytes(torch.from_numpy(image)), folder / "images" / f"{name}.png")
    planes = {**dict(zip("RGB", np.moveaxis(image, 2, 0), strict=True)), "A": alpha}
    save_floats(
        {key: plane.astype(np.float32) for key, plane in planes.items()},
        folder / "images" / f"{name}.exr",
    )
    if model == "tile":
        found: dict[str, Any] = {
            key: values.astype(np.float32)
            for key, values in _gradients(scene.setup).items()
        }
        with (folder / "gradients" / f"{name}.npz").open("wb") as file:
            np.savez_compressed(file, **found)


def _gradients(setup: Setup) -> dict[str, Array]:
    """Derivatives of the weighted sum of an image by the name of the attribute."""
    import numpy as np

    from mi_splat.oracle import Splat, gradients

    rows, columns, channels = np.ogrid[: setup.camera.height, : setup.camera.width, :3]
    weights = np.sin(rows + 2 * columns + 3 * channels)
    found = gradients(setup.splat, setup.camera, weights, background=setup.background)
    return dict(zip(Splat._fields, found, strict=True))


def _write_cameras(every: Mapping[str, ConformanceScene], folder: Path) -> None:
    from mi_splat.datasets.writing import list_colmap, list_transforms
    from mi_splat.io.camera_records import describe
    from mi_splat.io.documents import save_json

    cameras = {name: _camera(scene.setup.camera) for name, scene in every.items()}
    records = [
        {
            **describe(name, camera),
            **_opengl(every[name].setup.camera),
            "background": every[name].setup.background,
        }
        for name, camera in cameras.items()
    ]
    save_json({"near": 0.2, "cameras": records}, folder / "cameras.json")
    listing = {"train": [(f"{name}.png", camera) for name, camera in cameras.items()]}
    list_transforms(folder, listing, None)
    list_colmap(folder, listing, None)


def _camera(view: PinholeCamera) -> Camera:
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
    import numpy as np

    near = 0.2
    far = 1000.0
    projection = np.zeros((4, 4))
    projection[0, [0, 2]] = 2 * view.fx / view.width, 1 - 2 * view.cx / view.width
    projection[1, [1, 2]] = 2 * view.fy / view.height, 2 * view.cy / view.height - 1
    projection[2, 2:] = -(far + near) / (far - near), -2 * far * near / (far - near)
    projection[3, 2] = -1
    inverse = np.linalg.inv(view.to_world @ np.diag([1.0, -1.0, -1.0, 1.0]))
    return {
        "gl_view": inverse.T.ravel().tolist(),
        "gl_projection": projection.T.ravel().tolist(),
    }


# ------------------------------------------------------------------------------- images


def _draw_in_browser(
    options: ConformOptions, adapter: Path, every: Mapping[str, ConformanceScene]
) -> None:
    """Fill the folder of images with those that the page of an exported pack sends back
    from a headless browser.
    """
    import shutil
    import subprocess
    import tempfile
    import threading
    from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer

    from mi_splat.io.folders import new_folder

    browser = next(filter(None, map(shutil.which, _BROWSERS)), None)
    if browser is None or options.images is None or not adapter.is_file():
        got = "no browser" if browser is None else f"{options.images} and {adapter}"
        do = (
            f"install {_BROWSERS[0]}, or open viewer.html of the exported folder in"
            " another browser"
        )
        raise InvalidValueError.of(
            "--browser", "Chromium, a folder for the images and an adapter", got, do
        )
    ended = threading.Event()
    errors = list[str]()
    with (
        tempfile.TemporaryDirectory() as made,
        new_folder(options.images, force=options.force) as folder,
    ):
        pack = Path(made) / "pack"
        _write_inputs(every, pack, (".ply",))
        (pack / "adapter.js").write_bytes(adapter.read_bytes())

        class Handler(SimpleHTTPRequestHandler):
            def do_PUT(self) -> None:
                body = self.rfile.read(int(self.headers["Content-Length"]))
                name = self.path.strip("/")
                if name in every:
                    (folder / f"{name}.png").write_bytes(body)
                elif name == "end":
                    errors.append(body.decode())
                    ended.set()
                self.send_response(204)
                self.end_headers()

            def log_message(self, *_: Any) -> None: ...

        with ThreadingHTTPServer(
            ("127.0.0.1", 0), partial(Handler, directory=str(pack))
        ) as server:
            threading.Thread(target=server.serve_forever, daemon=True).start()
            address = f"http://127.0.0.1:{server.server_port}/viewer.html?send"
            words = [browser, *_SWITCHES, f"--user-data-dir={made}/user", address]
            with subprocess.Popen(words, stderr=subprocess.DEVNULL) as process:
                ended.wait(_PATIENCE)
                process.terminate()
            server.shutdown()
    if not ended.is_set() or errors[0]:
        got = errors[0] if errors else f"no end within {_PATIENCE} seconds"
        raise InvalidValueError.of(
            str(adapter),
            "images of every splat",
            got,
            "open viewer.html in a browser to see why",
        )


def _compare_images(
    options: ConformOptions, every: Mapping[str, ConformanceScene]
) -> int:
    import numpy as np

    from mi_splat.conformance import find_deviations

    assert options.images is not None
    with progress("comparing") as advance:
        given = dict(_images(options.images, every))
        missing = [name for name in every if name not in given]
        if missing:
            warn(f"no image of {', '.join(missing)}: these facts are not tested")
        setups = {name: _as_read(every[name], options.format) for name in given}
        by_model = dict[str, list[dict[str, Any]]]()
        for model in ("tile", "ray") if options.model == "tile" else ("ray", "tile"):
            by_model[model] = []
            for name, (image, bits) in given.items():
                advance(f"{name}, {model}")
                reference = np.dstack(_reference(setups[name], model))[
                    ..., : image.shape[2]
                ]
                by_model[model].append(
                    {"name": name, **_distance(image, reference, bits)}
                )
            if all(row["conforms"] for row in by_model[model]):
                break
        rows = by_model[options.model]
        conforming = {
            key: sum(r["conforms"] for r in by_model[key]) for key in by_model
        }
        better = max(
            conforming, key=lambda key: (conforming[key], key == options.model)
        )
        images = {
            row["name"]: given[row["name"]][0][..., :3]
            for row in rows
            if row["psnr"] is not None
        }
        advance("looking for causes")
        wrong = conforming[options.model] < len(rows)
        if wrong and options.model == "tile":
            causes = find_deviations(images, setups)
        else:
            causes = []
    found = [
        {
            "switch": c.deviation.switch,
            "value": c.deviation.value,
            "kind": c.deviation.kind,
            "decibels": c.decibels,
        }
        for c in causes
    ]
    settings = {
        "size": options.size,
        "model": options.model,
        "format": options.format,
        "by_model": conforming,
    }
    document = {
        "story": "conformance",
        "images": str(options.images),
        **settings,
        "scenes": rows,
        "causes": found,
    }
    if options.out is not None:
        _save_page(options, options.out, document, images, setups)
    lines = _lines(rows, causes)
    if better != options.model:
        lines.append(
            f"{conforming[better]} images conform to the reference of --model {better}:"
            " compare with that."
        )
    show_result(document, *lines, as_json=options.json)
    if wrong:
        return DIFFERS
    return 0


def _images(
    folder: Path, every: Mapping[str, ConformanceScene]
) -> Iterator[tuple[str, tuple[Array, int]]]:
    """The images of a folder by scene, (H, W, 3 or 4 with alpha that says something)
    each, with their bits.
    """
    import numpy as np

    from mi_splat.io.picture_files import load_picture
    from mi_splat.render.renderer import load_floats

    files = (
        (name, folder / f"{name}{end}") for name in every for end in (".png", ".exr")
    )
    found = [pair for pair in files if pair[1].is_file()]
    do = "render what mi-splat conform --export writes"
    _check_some(found, folder, f"images such as {next(iter(every))}.png", do)
    for name, path in found:
        if path.suffix == ".png":
            image = (
                np.asarray(load_picture(path).convert("RGBA"), dtype=np.float64) / 255
            )
            image[..., :3] *= image[..., 3:]
            yield name, (image if image[..., 3].min() < 1 else image[..., :3], 8)
        else:
            planes = load_floats(path)
            if not {*"RGB"} <= {*planes}:
                raise InvalidValueError.of(
                    str(path),
                    "channels R, G and B",
                    ", ".join(planes),
                    "write an RGB image",
                )
            channels = "RGBA" if "A" in planes and planes["A"].min() < 1 else "RGB"
            yield (
                name,
                (
                    np.stack([planes[channel] for channel in channels], axis=2).astype(
                        np.float64
                    ),
                    32,
                ),
            )


def _as_read(scene: ConformanceScene, suffix: str) -> Setup:
    """The setup with what a format keeps of its splat."""
    import numpy as np

    from mi_splat.oracle import Splat

    if suffix == ".ply":
        return scene.setup
    values = Splat(
        *(
            tensor.numpy().astype(np.float64)
            for tensor in _through_file(scene, suffix).tensors()
        )
    )
    opacities = np.clip(values.opacities, 1e-9, 1 - 1e-9)
    logits = np.log(opacities / (1 - opacities))
    stored = values._replace(
        scales=np.log(np.maximum(values.scales, 1e-30)), opacities=logits
    )
    return replace(scene.setup, stored=stored)


def _reference(setup: Setup, model: str) -> tuple[Array, Array]:
    from mi_splat.oracle import render_rays

    if model == "ray":
        return render_rays(setup.splat, setup.camera, background=setup.background)
    return setup.render()[:2]


def _distance(image: Array, reference: Array, bits: int) -> dict[str, Any]:
    """How far an image is from its reference, as a screen shows both."""
    import math

    import numpy as np

    from mi_splat.conformance import error

    if image.shape != reference.shape:
        return {
            "conforms": False,
            "psnr": None,
            "largest": None,
            "got": f"{image.shape[1]} x {image.shape[0]} pixels",
        }
    psnr = -10 * math.log10(max(error(image, reference), 1e-12))
    largest = float(np.abs(np.clip(image, 0, 1) - np.clip(reference, 0, 1)).max())
    return {
        "conforms": psnr >= _PSNR[bits] and largest <= _LARGEST[bits],
        "psnr": psnr,
        "largest": largest,
    }


def _words(row: Mapping[str, Any]) -> str:
    """How far an image is off."""
    return row.get("got") or f"{row['psnr']:.1f} dB, at most {row['largest']:.3f}"


def _lines(rows: list[dict[str, Any]], causes: list[Cause]) -> list[str]:
    lines = [
        f"{row['name']:18}{_VERDICTS[row['conforms']]:10}{_words(row)}" for row in rows
    ]
    good = sum(row["conforms"] for row in rows)
    lines.append(f"{good} of {len(rows)} images conform.")
    for cause in causes:
        switch, value, kind, _ = cause.deviation
        lines.append(
            f"likely cause      {switch}: {value} ({kind}; explains"
            f" {cause.decibels:.0f} dB over all images)"
        )
    if good < len(rows) and not causes:
        lines.append("No known deviation explains the differences.")
    return lines


def _save_page(
    options: ConformOptions,
    out: Path,
    document: dict[str, Any],
    images: Mapping[str, Array],
    setups: Mapping[str, Setup],
) -> None:
    """Write the table as Markdown, and for each image that differs image, reference and
    difference side by side.
    """
    import numpy as np
    import torch

    from mi_splat.io.documents import save_json, save_png, save_text
    from mi_splat.io.folders import new_folder
    from mi_splat.io.images import to_bytes

    with new_folder(out, force=options.force) as folder:
        lines = ["# Conformance", "", "| scene | | difference |", "|---|---|---|"]
        lines += [
            f"| {row['name']} | {_VERDICTS[row['conforms']]} | {_words(row)} |"
            for row in document["scenes"]
        ]
        lines += [
            "",
            *(
                f"- {c['switch']}: {c['value']} ({c['decibels']:.0f} dB)"
                for c in document["causes"]
            ),
        ]
        for row in document["scenes"]:
            name = row["name"]
            if not row["conforms"] and name in images:
                reference = _reference(setups[name], options.model)[0]
                trio = (images[name], reference, 4 * np.abs(images[name] - reference))
                save_png(
                    to_bytes(torch.from_numpy(np.concatenate(trio, axis=1))),
                    folder / f"{name}.png",
                )
                lines += [
                    "",
                    f"{name}: image, reference, difference x 4",
                    "",
                    f"![{name}]({name}.png)",
                ]
        save_text("\n".join(lines) + "\n", folder / "conformance.md")
        save_json(document, folder / "result.json")


# -------------------------------------------------------------------------------- files


def _compare_values(
    options: ConformOptions, folder: Path, every: Mapping[str, ConformanceScene]
) -> int:
    """Compare the values of converted files with those of the PLY, and with what our
    writer rounds of them.
    """
    from mi_splat.cli.convert import differences
    from mi_splat.io.errors import SplatFileError
    from mi_splat.io.splat_files import suffix_of

    rows = list[dict[str, Any]]()
    files = (
        (scene, path)
        for name, scene in every.items()
        for path in sorted(folder.glob(f"{name}.*"))
    )
    for scene, path in (pair for pair in files if suffix_of(pair[1].name)):
        before = _through_file(scene, ".ply")
        row: dict[str, Any] = {"name": scene.name, "file": str(path), "conforms": False}
        rows.append(row)
        try:
            after = _load(path)
        except SplatFileError as problem:
            row |= {"unreadable": str(problem), "text": f"unreadable: {problem}"}
            continue
        row |= {
            "gaussians": [len(before), len(after)],
            "text": f"expected {len(before)} Gaussians, got {len(after)}",
        }
        if len(before) == len(after):
            changes = differences(before, after.select(_nearest(before, after)))
            rounding = differences(
                before, _through_file(scene, suffix_of(path.name) or "")
            )
            # A ratio that has not changed is 1, and any other change 0.
            limits = {
                key: 3 * value - 2 * key.endswith("ratio") + _CHANGE
                for key, value in rounding.items()
            }
            row["conforms"] = all(
                value <= limits.get(key, _CHANGE) for key, value in changes.items()
            )
            row |= {"largest_changes": changes, "rounding": rounding}
            row["text"] = ", ".join(
                f"{key.partition(',')[0]} {value:.2g}" for key, value in changes.items()
            )
    _check_some(
        rows,
        folder,
        f"files such as {next(iter(every))}.spz",
        "convert what mi-splat conform --export writes",
    )
    return _report(options, "files", rows)


def _check_some(rows: list[Any], folder: Path, expected: str, do: str) -> None:
    if not rows:
        raise InvalidValueError.of(str(folder), expected, "none", do)


def _nearest(before: GaussianScene, after: GaussianScene) -> Any:
    """Of each Gaussian the row of its partner, since some formats sort them."""
    import torch
    from scipy.optimize import linear_sum_assignment

    first, second = (
        torch.cat([s.means, s.scales, s.opacities[:, None], s.sh[:, 0]], dim=1)
        for s in (before, after)
    )
    return torch.from_numpy(
        linear_sum_assignment(torch.cdist(first, second).numpy())[1]
    )


def _compare_gradients(
    options: ConformOptions, folder: Path, every: Mapping[str, ConformanceScene]
) -> int:
    """Compare gradients with exact ones, attribute by attribute: the length of the
    difference, as a part of theirs.
    """
    import numpy as np

    from mi_splat.cli.conform_gradients import read_gradients

    rows = list[dict[str, Any]]()
    for name, scene in every.items():
        if not (path := folder / f"{name}.npz").is_file():
            continue
        exact = _gradients(scene.setup)
        lengths = {key: float(np.linalg.norm(values)) for key, values in exact.items()}
        floor = _GRADIENT_FLOOR * max(lengths.values())
        off = dict[str, float | None]()
        for key, values in read_gradients(path, exact).items():
            if values.shape != exact[key].shape:
                off[key] = None
                continue
            error = float(np.linalg.norm(values - exact[key]))
            off[key] = error / (max(lengths[key], floor) or 1.0)
        good = bool(off) and all(
            value is not None and value <= _GRADIENT for value in off.values()
        )
        text = ", ".join(
            f"{key} {'of another shape' if v is None else f'{v:.2g}'}"
            for key, v in off.items()
        )
        rows.append(
            {
                "name": name,
                "file": str(path),
                "conforms": good,
                "relative_errors": off,
                "text": text,
            }
        )
    do = "save them as mi-splat conform --export does"
    _check_some(
        rows,
        folder,
        f"gradients such as {next(iter(every))}.npz with arrays such as means",
        do,
    )
    return _report(options, "gradients", rows)


def _report(options: ConformOptions, key: str, rows: list[dict[str, Any]]) -> int:
    lines = [
        f"{Path(row['file']).name:30}{_VERDICTS[row['conforms']]:10}{row.pop('text')}"
        for row in rows
    ]
    show_result({key: rows}, *lines, as_json=options.json)
    if all(row["conforms"] for row in rows):
        return 0
    return DIFFERS
