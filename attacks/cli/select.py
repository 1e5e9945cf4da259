"""`mi-splat select`: one object of a splat, tinted in an image, as a mask, or as a
splat of its own.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from attacks.cli.options import DetectorOptions, box_finder
from mi_splat.cli.console import progress, show_result, warn
from mi_splat.cli.flags import Positional
from mi_splat.cli.options import CameraOptions, JsonOptions
from mi_splat.errors import InvalidValueError
from mi_splat.fields import OutFile
from mi_splat.selection.config import Selection

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray
    from torch import Tensor

    from mi_splat.cameras.camera import Camera, RenderFn
    from mi_splat.render.scene_files import SplatScene
    from mi_splat.scene import GaussianScene


EXAMPLES = (
    "select YOUR.ply --click 320,240 --out picked.png mask.npy",
    "select YOUR.ply --box -0.2 -0.2 0 0.2 0.2 0.3 --cameras orbit:8@30",
    (
        "select YOUR.ply --detect car --detectors nanodet_coco --cameras YOUR_PHOTOS"
        " --out picked.png mask.npy"
    ),
    "select YOUR.ply --masks YOUR_MASKS --cameras YOUR_PHOTOS --out mask.npy",
    "select scenes/car_street.xml --object car --out car.ply",
)


@dataclass(frozen=True, kw_only=True)
class SelectOptions(DetectorOptions, JsonOptions):
    """Select one object of a splat, and check the selection.

    Prints how many Gaussians it has, where they are, what share of the image it covers,
    and warnings about the selection. The same flags choose the object of `mi-splat
    dagger` and `mi-splat evaluate`.
    """

    scene: Positional[Path]
    """A splat file, or a scene XML made of splats."""
    selection: Selection = field(default_factory=Selection)
    """Which object."""
    view: CameraOptions = field(default_factory=CameraOptions)
    """Cameras; --click refers to the first one, whose image is written."""
    out: tuple[OutFile, ...] = ()
    """Any of: a .png or .jpg of the scene with the object tinted, the mask as .npy, the
    object's Gaussians as .ply. Default: nothing is written.
    """
    force: bool = False
    """Replace existing files."""


LISTED = 6
"""Cameras with a line of their own at most."""
LONGEST_SIDE = 1024
"""Pixels of the longer side of images in which shares are counted."""
TINT = (1.0, 0.0, 0.8)
"""sRGB colour of the object in the image, mixed half and half with its own."""


def run(options: SelectOptions) -> None:
    """Select, save, and say what was selected."""
    from mi_splat.cli.cameras import choose
    from mi_splat.io.folders import check_free_file, check_not_input
    from mi_splat.io.images import is_picture
    from mi_splat.render.scene_files import open_scene
    from mi_splat.selection.agreement import summary
    from mi_splat.selection.select import SEEN

    for path in options.out:
        if not (is_picture(path) or path.suffix.lower() in (".npy", ".ply")):
            raise InvalidValueError.of(
                "--out",
                "names that end in .png, .jpg, .npy or .ply",
                path,
                "change the ending",
            )
        check_not_input(path, options.scene, options.selection.mask)
        check_free_file(path, force=options.force)
    with progress("selecting"):
        loaded = open_scene(options.scene)
        chosen = choose(
            loaded,
            options.selection,
            options.view,
            find_boxes=box_finder(options.detectors, options.weights),
        )
        scene = loaded.scene
        mask = chosen.mask
        weights = replace(chosen, cameras=_smaller(chosen.cameras)).weights(loaded)
        agreed = chosen.agreement(loaded)
        doubts = chosen.doubts(weights, agreed)
        first = next(iter(chosen.cameras.values()))
        for path in options.out:
            path.parent.mkdir(parents=True, exist_ok=True)
            _save(path, loaded, mask, first, chosen.render)
    views: list[dict[str, Any]] = [
        {
            "camera": name,
            "seen": bool((weight >= SEEN).any()),
            "share": float((weight >= SEEN).double().mean()),
            "highest": float(weight.max()),
        }
        for name, weight in weights.items()
    ]
    box = [scene.means[mask].amin(0).tolist(), scene.means[mask].amax(0).tolist()]
    document = {
        **{"gaussians": int(mask.sum()), "of": len(mask), "box": box, "views": views},
        "selection": options.selection.as_dict(),
        "outlines": {name: item._asdict() for name, item in agreed.items()},
        "doubts": doubts,
        "files": [str(path) for path in options.out],
    }
    for doubt in doubts:
        warn(f"warning: {doubt}")
    low, high = (" ".join(f"{value:.4g}" for value in corner) for corner in box)
    lines = [
        f"{document['gaussians']:,} of {len(mask):,} Gaussians, in the box {low} {high}"
    ]
    if chosen.found is not None:
        lines += chosen.found.lines
        lines.append(summary(agreed))
    for view in views[:LISTED]:
        seen = "seen" if view["seen"] else "not seen"
        lines.append(f"{seen} by {view['camera']}: {view['share']:.1%} of the pixels")
    if len(views) > LISTED:
        shares = [view["share"] for view in views if view["seen"]]
        if shares:
            of_pixels = f", {min(shares):.1%} to {max(shares):.1%} of the pixels"
        else:
            of_pixels = ""
        lines.append(f"seen by {len(shares)} of {len(views)} cameras in all{of_pixels}")
    show_result(document, *lines, *map(str, options.out), as_json=options.json)


def _save(
    path: Path,
    loaded: SplatScene,
    mask: Tensor,
    camera: Camera,
    render: RenderFn,
) -> None:
    from mi_splat.io import save_splat
    from mi_splat.io.images import save_picture
    from mi_splat.selection.select import save_mask
    from mi_splat.selection.visibility import object_weight

    if path.suffix.lower() == ".npy":
        save_mask(mask, path)
    elif path.suffix.lower() == ".ply":
        save_splat(
            loaded.scene.select(mask), path, antialiased=loaded.settings.antialiased
        )
    else:
        weight = object_weight(loaded.scene, mask, camera, render)
        save_picture(tinted(loaded.scene, weight, camera, render), path)


def _smaller(cameras: Mapping[str, Camera]) -> dict[str, Camera]:
    """The cameras with images of no more pixels than shares of them need: those of
    photographs may have twelve million.
    """
    from mi_splat.render.scene_files import resized

    small = {}
    for name, camera in cameras.items():
        factor = min(1.0, LONGEST_SIDE / max(camera.width, camera.height))
        size = (round(camera.width * factor), round(camera.height * factor))
        small[name] = resized(camera, size)
    return small


def tinted(
    scene: GaussianScene, weight: Tensor, camera: Camera, render: RenderFn
) -> NDArray[np.uint8]:
    """The image of a scene in which an object has another colour, and all else is
    paler.
    """
    import torch

    from mi_splat.io.images import to_bytes

    with torch.no_grad():
        picture = render(scene, camera)[..., :3].clamp(0, 1)
    share = weight[..., None].to(picture)
    tint = 0.5 * picture + 0.5 * torch.tensor(TINT).to(picture)
    pixels: NDArray[np.uint8] = to_bytes(
        share * tint + (1 - share) * (0.35 + 0.65 * picture.mean(-1, keepdim=True))
    )
    return pixels
