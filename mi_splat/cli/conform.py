"""`mi-splat conform`: whether a renderer or a converter of others does what 3D Gaussian
Splatting defines.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from mi_splat.cli.console import (
    UsageError,
    import_at_once,
    progress,
    show_result,
)
from mi_splat.cli.flags import Positional
from mi_splat.cli.options import JsonOptions
from mi_splat.errors import InvalidValueError
from mi_splat.fields import Metavar, OutFolder

if TYPE_CHECKING:
    from mi_splat.conformance.comparison import Report
    from mi_splat.conformance.files import FoundImage
    from mi_splat.conformance.scenes import ConformanceScene
    from mi_splat.conformance.setups import Setup

EXAMPLES = (
    "conform --list",
    "conform --export out/conformance",
    "conform YOUR_IMAGES",
    "conform YOUR_IMAGES --profile webgl --accept sh-degree=2 --out out/report",
    "conform YOUR_IMAGES --browser adapter.js",
    "conform --read YOUR_CONVERTED_FILES",
    "conform --gradients YOUR_GRADIENTS",
)
DIFFERS = 3
"""Exit status where something does not conform, or is missing."""


@dataclass(frozen=True, kw_only=True)
class ConformOptions(JsonOptions):
    """Test a renderer against the definition of 3D Gaussian Splatting, and name what it
    does differently.

    --export writes small splats, cameras, and for each the exact image and its
    gradients. Render every splat from its camera, save the images as NAME.png or
    NAME.exr (with the values of the PNG, not linear ones), and pass their folder: each
    is compared with the reference, and the likely causes of differences are found by
    fitting. The exit status is 3 if something differs or an image is missing.
    """

    images: Positional[Path | None] = None
    """Folder with the images of a renderer, called as the splats: PNG, JPEG, EXR or
    NPY.
    """
    list: bool = False
    """List the splats and what each shows, and the deviations that are known."""
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
    """Pixels on each side, of what is exported or drawn in a browser."""
    profile: str = "3dgs"
    """What the renderer is meant to be: 3dgs, antialiased, gsplat, khr
    (KHR_gaussian_splatting), webgl, or ray (each Gaussian where it is densest along a
    ray).
    """
    accept: tuple[str, ...] = ()
    """What is meant besides, as --list names it (order=distance), and scenes to leave
    out.
    """
    cannot: tuple[str, ...] = ()
    """What the renderer lacks, as --list names it (off-centre): scenes that need it are
    not applicable.
    """
    out: OutFolder | None = None
    """Folder for a page with the images that differ, a table and result.json; nothing
    is written without it.
    """
    force: bool = False
    """Replace an older result in --out or --export."""


def run(options: ConformOptions) -> int:
    """List, export or compare."""
    given = options.images, options.export, options.read, options.gradients
    tasks = [options.list, *(path is not None for path in given)]
    if sum(tasks) != 1:
        raise UsageError(
            "expected one of a folder of images, --list, --export, --read and"
            " --gradients; pass only one"
        )
    # These need NumPy only, so that they answer at once.
    if options.list:
        return _list(options)
    if options.gradients is not None:
        return _compare_gradients(options, options.gradients)

    from mi_splat.conformance.scenes import conformance_scenes

    if options.out is not None:
        from mi_splat.io.folders import check_new_folder

        check_new_folder(options.out, force=options.force)
    scenes = {scene.name: scene for scene in conformance_scenes(options.size)}
    if options.export is not None or options.read is not None:
        import_at_once("torch")
    if options.export is not None:
        return _export(options, options.export, scenes)
    if options.read is not None:
        return _compare_files(options, options.read, scenes)
    assert options.images is not None
    if options.browser is not None:
        from mi_splat.cli.conform_browser import draw_in_browser

        draw_in_browser(options.browser, options.images, scenes, force=options.force)
    return _compare_images(options, options.images)


def _list(options: ConformOptions) -> int:
    from mi_splat.conformance.catalogue import catalogue, catalogue_lines

    show_result(catalogue(), *catalogue_lines(), as_json=options.json)
    return 0


def _export(
    options: ConformOptions, out: Path, scenes: Mapping[str, ConformanceScene]
) -> int:
    from mi_splat.cli.conform_pack import PackSettings, write_pack
    from mi_splat.io.folders import new_folder

    settings = PackSettings(
        size=options.size, profile=options.profile, formats=options.formats
    )
    with (
        progress("writing", len(scenes)) as advance,
        new_folder(out, force=options.force) as folder,
    ):
        document = write_pack(scenes, folder, settings, advance)
    show_result(
        {"out": str(out), **document},
        f"{out}: {len(scenes)} splats with references",
        as_json=options.json,
    )
    return 0


# ------------------------------------------------------------------------------- images


def _compare_images(options: ConformOptions, folder: Path) -> int:
    from mi_splat.cli.conform_pack import as_read
    from mi_splat.conformance.comparison import compare_setups, scenes_for
    from mi_splat.conformance.files import read_images
    from mi_splat.conformance.scenes import SIZES, conformance_scenes

    names = [scene.name for scene in conformance_scenes(SIZES[0])]
    readers = {
        ".exr": _read_exr,
        ".png": _read_picture,
        ".jpg": _read_picture,
        ".jpeg": _read_picture,
    }
    images = read_images(folder, names, readers)
    setups = {
        scene.name: as_read(scene, options.format) for scene in scenes_for(images)
    }
    with progress("comparing") as advance:
        report = compare_setups(
            images,
            setups,
            profile=options.profile,
            accept=options.accept,
            cannot=options.cannot,
            advance=advance,
        )
    document = {
        "story": "conformance",
        "images": str(folder),
        "format": options.format,
        **report.as_dict(),
    }
    if options.out is not None:
        _save_page(options, options.out, report, document, images, setups)
    show_result(document, *report.lines(), as_json=options.json)
    return 0 if report.conforms else DIFFERS


def _read_picture(path: Path) -> FoundImage:
    import numpy as np

    from mi_splat.conformance.files import as_image
    from mi_splat.io.picture_files import load_picture

    return as_image(np.asarray(load_picture(path).convert("RGBA")), str(path))


def _read_exr(path: Path) -> FoundImage:
    import numpy as np

    from mi_splat.conformance.files import as_image
    from mi_splat.render.renderer import load_floats

    planes = load_floats(path)
    if not {*"RGB"} <= {*planes}:
        got = ", ".join(planes)
        raise InvalidValueError.of(
            str(path), "channels R, G and B", got, "write an RGB image"
        )
    channels = "RGBA" if "A" in planes else "RGB"
    return as_image(np.stack([planes[key] for key in channels], axis=2), str(path))


def _save_page(
    options: ConformOptions,
    out: Path,
    report: Report,
    document: dict[str, Any],
    images: Mapping[str, FoundImage],
    setups: Mapping[str, Setup],
) -> None:
    """Write the table as Markdown, and for each image that differs image, reference and
    difference side by side.
    """
    import numpy as np
    import torch

    from mi_splat.conformance.comparison import as_meant
    from mi_splat.io.documents import save_json, save_png, save_text
    from mi_splat.io.folders import new_folder
    from mi_splat.io.images import to_bytes

    lines = ["# Conformance", "", "| scene | | difference |", "|---|---|---|"]
    lines += [
        f"| {row.name} | {'conforms' if row.conforms else 'differs'} | {row.text} |"
        for row in report.scenes
    ]
    lines.append("")
    lines += [
        f"- {cause.deviation.key}: {cause.deviation.text}, which explains"
        f" {', '.join(cause.scenes)}"
        for cause in report.causes
    ]
    if report.unexplained:
        lines.append(f"- unexplained: {', '.join(report.unexplained)}")
    if report.missing:
        lines.append(f"- missing: {', '.join(report.missing)}")
    for name, needed in report.not_applicable.items():
        lines.append(f"- not applicable: {name}, which needs {', '.join(needed)}")
    with new_folder(out, force=options.force) as folder:
        for row in report.scenes:
            if row.conforms or row.error is None:
                continue
            name = row.name
            image = images[name].values[..., :3]
            setup = as_meant(setups[name], options.profile, options.accept)
            reference, _ = setup.render()
            trio = (image, reference, 4 * np.abs(image - reference))
            pixels = to_bytes(torch.from_numpy(np.concatenate(trio, axis=1)))
            save_png(pixels, folder / f"{name}.png")
            title = f"{name}: image, reference, difference x 4"
            lines += ["", title, "", f"![{name}]({name}.png)"]
        save_text("\n".join(lines) + "\n", folder / "conformance.md")
        save_json(document, folder / "result.json")


# ---------------------------------------------------------------- files and gradients


def _compare_files(
    options: ConformOptions, folder: Path, scenes: Mapping[str, ConformanceScene]
) -> int:
    from mi_splat.cli.conform_read import compare_files

    rows = compare_files(folder, scenes)
    lines = []
    for row in rows:
        verdict = "conforms" if row["conforms"] else "differs"
        lines.append(f"{Path(row['file']).name:30}{verdict:10}{row.pop('text')}")
    show_result({"files": rows}, *lines, as_json=options.json)
    return 0 if all(row["conforms"] for row in rows) else DIFFERS


def _compare_gradients(options: ConformOptions, folder: Path) -> int:
    from mi_splat.conformance.gradients import compare_gradients

    report = compare_gradients(folder, size=options.size)
    show_result(report.as_dict(), *report.lines(), as_json=options.json)
    return 0 if report.conforms else DIFFERS
