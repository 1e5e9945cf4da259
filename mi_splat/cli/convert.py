"""`mi-splat convert`: a splat file in another format, and what the new file does not
hold.
"""

from __future__ import annotations

import dataclasses
import math
import os
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from mi_splat.cli.console import progress, show_result
from mi_splat.cli.flags import Positional
from mi_splat.cli.options import JsonOptions
from mi_splat.errors import InvalidValueError
from mi_splat.fields import Metavar, OutFile, above
from mi_splat.maths.orientation import Up, turn_of

if TYPE_CHECKING:
    from torch import Tensor

    from mi_splat.scene import GaussianScene


EXAMPLES = (
    "convert YOUR.ply YOUR.spz",
    "convert YOUR.sog out/web.ply",
    "convert YOUR.ply small.sog --sh-degree 1",
    "convert YOUR.ply upright.ply --up -y --scale 0.1",
)


@dataclass(frozen=True, kw_only=True)
class ConvertOptions(JsonOptions):
    """Convert a splat file to another format, which the ending of its name says.

    Says what the new file does not hold, and how far its values are off.
    """

    source: Positional[Path]
    """Splat to read: .ply, .compressed.ply, .spz, .sog, .glb, .usdc, .usda, .usdz or
    .splat.
    """
    out: Positional[OutFile]
    """Splat to write: .ply, .compressed.ply, .spz, .sog, .glb, .usdc, .usda, .usdz or
    .splat.
    """
    force: bool = False
    """Replace an existing file."""
    sh_degree: Literal[0, 1, 2, 3] | None = None
    """Truncate spherical harmonics above this degree. Default: what the format holds.
    """
    spz_version: Literal[2, 3, 4] | None = None
    """Version of an SPZ file. Default: 3."""
    drop_invalid: bool = False
    """Leave out Gaussians that are not valid, instead of an error."""
    up: Up | None = None
    """Up axis of the file, which is rotated to z. Default: no rotation."""
    scale: Annotated[
        float, above(0, do="0.01 makes metres of centimetres"), Metavar("FACTOR")
    ] = 1.0
    """What one unit of the file becomes, more than 0."""


def run(options: ConvertOptions) -> None:
    """Convert, read the new file back, and say how it differs."""
    import torch

    from mi_splat.io.folders import check_free_file, check_not_input, splat_in
    from mi_splat.io.loaded import dropped_bands, ranges
    from mi_splat.io.splat_files import (
        format_to_write,
        load_stored,
        write_splat_file,
    )
    from mi_splat.scene import Similarity

    # a name that fits no format is told before a large file is read
    chosen, suffix = format_to_write(str(options.out))
    if options.spz_version is not None and not chosen.versions:
        raise InvalidValueError.of(
            "--spz-version", "a file to write that ends in .spz", suffix, "leave it out"
        )
    check_not_input(options.out, options.source)
    check_free_file(options.out, force=options.force)
    with progress(f"reading {options.source}"):
        invalid: Literal["drop", "raise"] = "drop" if options.drop_invalid else "raise"
        stored = load_stored(options.source).settle(
            str(options.source), invalid, stacklevel=1
        )
        scene = stored.scene
        if options.up is not None or options.scale != 1:
            turn = torch.from_numpy(turn_of(options.up or "z"))
            scene = scene.transform(
                Similarity(
                    rotation=turn, translation=torch.zeros(3), scale=options.scale
                )
            )
    antialiased = stored.is_antialiased
    not_kept = ranges(stored.unread)
    if antialiased and not chosen.keeps_antialiasing:
        not_kept.append("that it was trained with antialiasing (render mode)")
    with progress(f"writing {options.out}"):
        if options.sh_degree is None:
            kept = scene
        else:
            kept = scene.with_degree(min(options.sh_degree, scene.degree))
        options.out.parent.mkdir(parents=True, exist_ok=True)
        encoded = write_splat_file(
            kept,
            options.out,
            version=options.spz_version,
            antialiased=antialiased,
        )
        reread = load_stored(options.out).scene
    if encoded.order is None:
        written = scene
    else:
        written = scene.select(torch.from_numpy(encoded.order))
    changes = differences(written, reread)
    losses = (*dropped_bands(scene.sh.numpy(), kept.degree), *encoded.losses)
    sizes = (
        os.path.getsize(splat_in(options.source) or options.source),
        options.out.stat().st_size,
    )
    document = {
        "source": str(options.source),
        "out": str(options.out),
        "gaussians": len(reread),
        "bytes_before": sizes[0],
        "bytes_after": sizes[1],
        "sh_degree_before": scene.degree,
        "sh_degree_after": reread.degree,
        "reordered": encoded.order is not None,
        "largest_changes": changes,
        "lost": [dataclasses.asdict(loss) for loss in losses],
        "not_kept": not_kept,
    }
    lines = [
        f"file            {options.out}, {sizes[1]:,} bytes",
        f"gaussians       {len(reread):,}",
        f"sh degree       {scene.degree} before, {reread.degree} after",
        *([f"up              {options.up} of the file is z now"] if options.up else []),
        f"order           {'changed' if encoded.order is not None else 'kept'}",
        *(f"largest change  {name}: {value:.3g}" for name, value in changes.items()),
        *(f"lost: {loss}" for loss in losses),
        *(f"not kept: {name}" for name in not_kept),
    ]
    show_result(document, *lines, as_json=options.json)


def differences(before: GaussianScene, after: GaussianScene) -> dict[str, float]:
    """How far the values of two scenes with the same rows are apart at most, by what it
    is measured in.

    Colours are those of the first SH coefficients, from 0 to 1. SH that only one scene
    has count as zero in the other.
    """
    import torch

    from mi_splat.maths.sh import dc_to_colour

    degree = max(before.degree, after.degree)
    old = before.with_degree(degree)
    new = after.with_degree(degree)
    # q and -q are one rotation, and half a turn about an axis of its own leaves a
    # Gaussian as it is.
    w, x, y, z = new.rotations.double().T
    same = torch.stack(
        [w, x, y, z, -x, w, z, -y, -y, -z, w, x, -z, y, -x, w], dim=1
    ).reshape(-1, 4, 4)
    chord = (
        (old.rotations.double()[:, None] - torch.cat([same, -same], dim=1))
        .norm(dim=2)
        .amin(1)
    )
    changes = {
        "means, world units": _largest(old.means - new.means),
        "scales, ratio": math.exp(
            _largest(old.scales.double().log() - new.scales.double().log())
        ),
        "rotations, degrees": math.degrees(
            4 * math.asin(min(1.0, _largest(chord) / 2))
        ),
        "opacity": _largest(old.opacities - new.opacities),
        "colour": _largest(dc_to_colour(old.sh[:, 0]) - dc_to_colour(new.sh[:, 0])),
    }
    if degree:
        changes["SH coefficients"] = _largest(old.sh[:, 1:] - new.sh[:, 1:])
    return changes


def _largest(values: Tensor) -> float:
    if values.numel():
        return float(values.abs().max())
    return 0.0
