"""`mi-splat example-scenes`: one of the shipped splat scenes, made again from its meshes."""

from __future__ import annotations

from mi_splat.cli.console import limit_threads, progress, show, show_json
from mi_splat.cli.options import ExampleScenesOptions
from mi_splat.example_scenes import make
from mi_splat.io.folders import check_writable


def run(options: ExampleScenesOptions) -> int:
    """Make the scene and say how good it is."""
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
    if options.json:
        show_json(record)
        return 0
    show(f"{options.out / options.name}.xml: made in {record['seconds']} s; the record is beside it (.json)")
    show(f"PSNR: {record['psnr_fitted']} dB on the pictures fitted to, {record['psnr_held_out']} dB on others")
    return 0
