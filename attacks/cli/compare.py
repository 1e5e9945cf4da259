"""`mi-splat compare`: several renderers on one splat."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from mi_splat import provenance
from mi_splat.cli.console import progress, show_result
from mi_splat.cli.flags import Positional
from mi_splat.cli.options import CameraOptions, ResultOptions
from mi_splat.fields import Metavar, OutFolder, between

EXAMPLES = (
    (
        "compare scenes/car_street.xml --methods tile,ray,volprim --cameras all --out"
        " out/compare"
    ),
    (
        "compare YOUR.ply --methods tile,folder:images --cameras cameras.json --out"
        " out/theirs"
    ),
)


@dataclass(frozen=True, kw_only=True)
class CompareOptions(ResultOptions):
    """Compare renderers on one splat: images, gradients and time.

    Writes result.json, table.md, the images of each method and a sheet for each camera
    (the images side by side, and where each two differ). Study files with study =
    "compare" vary a setting.

    Methods: tile matches the reference 3DGS rasteriser, tile-antialiased the same with
    the filter of Mip-Splatting; ray meets each Gaussian at its peak along the ray,
    ray-to-mean is the same with the colours of tile; volprim is Mitsuba's
    volprim_rf_basic; folder:PATH is a folder of images of any other program, named as
    the cameras. With meshes, path-traced-N traces all with N samples a pixel; other
    methods are composited over them.
    """

    scene: Positional[Path]
    """A splat file, or a scene XML."""
    methods: Annotated[tuple[str, ...], Metavar("METHOD")] = ("tile", "ray")
    """Two or more of these methods, with commas or spaces between them."""
    view: CameraOptions = field(default_factory=CameraOptions)
    """Where from."""
    out: OutFolder = Path("out/compare")
    gradients: bool = True
    """Whether gradients are compared, for methods that have them. --no-gradients: do
    not compare gradients.
    """
    rounds: Annotated[int, between(0, 1000, "rounds", "5 is usual")] = 5
    """Number of timing runs of each method; 0 measures no time."""


def run(options: CompareOptions) -> None:
    """Compare, and write what came of it."""
    from attacks.figures.tables import sections
    from attacks.studies.compare import Comparing, measured, tables
    from attacks.studies.running import TABLE
    from mi_splat.comparison.compare import CompareConfig, save_sheets
    from mi_splat.io.documents import save_json, save_text
    from mi_splat.io.folders import RECORD, check_new_folder, new_folder

    check_new_folder(options.out, force=options.force)
    measure = CompareConfig(gradients=options.gradients, rounds=options.rounds)
    config = Comparing(
        scene=str(options.scene),
        methods=options.methods,
        view=options.view,
        config=measure,
    )
    with progress("comparing") as advance:
        comparison, record = measured(config, advance)
        record = {"story": "compare", **record, **provenance.origin()}
        text = sections(tables({options.scene.name: record}))
        with new_folder(options.out, force=options.force) as folder:
            sheets = save_sheets(comparison.pictures, folder)
            save_json(record, folder / RECORD)
            save_text(
                text
                + "".join(f"\n![{sheet.stem}]({sheet.name})\n" for sheet in sheets),
                folder / TABLE,
            )
    show_result(
        {**record, "out": str(options.out)},
        text,
        f"{options.out}: images and {TABLE}",
        as_json=options.json,
    )
