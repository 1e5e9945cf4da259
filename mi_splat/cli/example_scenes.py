"""`mi-splat example-scenes`: one of the shipped splat scenes, made again from its meshes."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from mi_splat.cli.console import limit_threads, progress, show_result
from mi_splat.cli.flags import Positional
from mi_splat.cli.options import JsonOptions, Samples
from mi_splat.fields import Folder, Seed, Steps, at_least

EXAMPLES = ("example-scenes stop_sign --out out/scenes",)
SEE_ALSO = ("render", "dagger")


@dataclass(frozen=True, kw_only=True)
class ExampleScenesOptions(JsonOptions):
    """Make one of the splat scenes that the project ships, from its own meshes: pictures, start on surfaces, training.

    Writes NAME.xml, its two splats and NAME.json, a record with counts, settings, seed and PSNR, into --out. With the
    recipe's own numbers it takes about a quarter of an hour.
    """

    name: Positional[str]
    """car_street or stop_sign."""
    out: Folder = Path("scenes")
    """Folder for the files; made if it is not there. What is there under these names is replaced."""
    views: Annotated[int, at_least(1, "pictures")] | None = None
    """Pictures to fit to; None takes the recipe's number."""
    samples: Samples = 16
    """Samples per pixel in them; the pictures to compare with have twice as many."""
    steps: Steps | None = None
    """Steps of the training; None takes the recipe's number."""
    seed: Seed = 0
    """Seed of everything but the meshes."""


def run(options: ExampleScenesOptions) -> None:
    """Make the scene and say how good it is."""
    from mi_splat.example_scenes import make
    from mi_splat.io.folders import check_writable

    check_writable(options.out)
    limit_threads(1)
    with progress(f"making {options.name}") as advance:
        record = make(
            options.name,
            options.out,
            views=options.views,
            samples=options.samples,
            steps=options.steps,
            seed=options.seed,
            on_step=lambda stage, done, wanted: advance(f"{stage}: {done} of {wanted}"),
        )
    lines = (
        f"{options.out / options.name}.xml: made in {record['seconds']} s; the record is beside it (.json)",
        f"PSNR: {record['psnr_fitted']} dB on the pictures fitted to, {record['psnr_held_out']} dB on others",
    )
    show_result(record, *lines, as_json=options.json)
