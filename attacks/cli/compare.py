"""`mi-splat compare`: several renderers on one splat, with a page of what came of it.

It stands here and not among the commands of mi_splat, since its page is made by `attacks.report`.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Annotated

from mi_splat import provenance
from mi_splat.cli.console import progress, warn
from mi_splat.cli.flags import Positional
from mi_splat.cli.options import CameraOptions, ResultOptions
from mi_splat.errors import install
from mi_splat.fields import Metavar, OutFolder, Seed, between

EXAMPLES = (
    "compare scenes/car_street.xml --methods tile,ray,volprim --cameras all --out out/compare",
    "compare YOUR.ply --methods tile,folder:pictures --cameras cameras.json --out out/theirs",
)


@dataclass(frozen=True, kw_only=True)
class CompareOptions(ResultOptions):
    """Compare renderers on one splat: pictures, gradients and time.

    Writes result.json, a sheet for each camera (the pictures side by side, and where each two differ), the pictures
    of each method, and compare.html, a page that needs no network (it needs the extra `report`).

    Methods: tile is the picture of the reference 3DGS rasteriser, tile-antialiased the same with the filter of
    Mip-Splatting; ray meets each Gaussian at its peak along the ray, ray-to-mean is the same with the colours of tile;
    volprim is Mitsuba's volprim_rf_basic; gsplat is the package of that name, on an NVIDIA GPU; folder:PATH is a folder
    of pictures of any other program, called as the cameras.
    """

    scene: Positional[Path]
    """A splat file, or a scene XML made of splats."""
    methods: Annotated[tuple[str, ...], Metavar("METHOD")] = ("tile", "ray")
    """Two or more of these methods, with commas or spaces between them."""
    view: CameraOptions = field(default_factory=CameraOptions)
    """Where from."""
    out: OutFolder = Path("out/compare")
    gradients: bool = True
    """Compare the gradients of methods that have them."""
    rounds: Annotated[int, between(0, 1000, "rounds", "5 is usual")] = 5
    """How often each method is timed, in turn; 0 measures no time."""
    amplify: Annotated[float, between(1, 1000, "times", "8 is usual"), Metavar("FACTOR")] = 8.0
    """By how much differences are multiplied in the pictures."""
    seed: Seed = 0
    """Of the random weights of the pixels whose weighted sum is differentiated."""


def run(options: CompareOptions) -> None:
    """Compare, and write what came of it."""
    from attacks.cli.summary import show_summary
    from mi_splat.cli.cameras import find_cameras, renderer_of
    from mi_splat.comparison.compare import CompareConfig, as_dict, compare, save_sheets
    from mi_splat.comparison.methods import load_methods
    from mi_splat.io.camera_records import describe
    from mi_splat.io.documents import save_json
    from mi_splat.io.folders import RECORD, check_new_folder, new_folder
    from mi_splat.scene import scene_hash
    from mi_splat.scene_files import open_scene

    check_new_folder(options.out, force=options.force)
    with progress("loading") as advance:
        loaded = open_scene(options.scene)
        cameras = find_cameras(loaded, options.view)
        settings = renderer_of(loaded, options.view, cameras).settings
        methods = load_methods(options.methods, settings, cameras)
        config = CompareConfig(gradients=options.gradients, rounds=options.rounds, seed=options.seed)
        comparison = compare(loaded.scene, cameras, methods, config=config, on_step=advance)
        document = {
            "story": "compare",
            "scene": str(options.scene),
            "scene_hash": scene_hash(loaded.scene),
            "gaussians": len(loaded.scene),
            "given": list(options.methods),
            "background": list(settings.background),
            "near": settings.near,
            **asdict(config),
            "amplify": options.amplify,
            **as_dict(comparison, methods),
            "cameras": [describe(name, camera) for name, camera in cameras.items()],
            **provenance.origin(),
        }
        advance("writing")
        with new_folder(options.out, force=options.force) as folder:
            save_sheets(comparison.pictures, folder, factor=options.amplify)
            save_json(document, folder / RECORD)
            _save_page(folder, options.out)
    show_summary(options.out, as_json=options.json, tables=4)


def _save_page(folder: Path, out: Path) -> None:
    """Write the page into the folder, which will be called `out`, where the packages for it are there."""
    from attacks.report.page import missing_packages, write_page
    from attacks.report.results import read_section

    missing = missing_packages()
    if missing:
        warn(f"no page: {' and '.join(missing)} not installed; {install('report')}, then mi-splat report")
    else:
        write_page([replace(read_section(folder), folder=str(out))], folder / "compare.html")
