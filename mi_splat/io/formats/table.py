"""What each splat format keeps of a scene: one table, from which the documentation and the tests are made."""

from dataclasses import dataclass
from typing import NamedTuple


class Precision(NamedTuple):
    """How far a value may be off after it was saved and loaded.

    Attributes:
        error: Largest error of a value that was not clamped; 0 is to the bit.
        of: What the error is measured in.
        limits: Smallest and largest value that is kept, empty where there are none.
    """

    error: float
    of: str = ""
    limits: str = ""

    def __str__(self) -> str:
        """The cell of the table."""
        size = "exact" if not self.error else f"{self.error:.2g} {self.of}"
        return f"{size}, clamped to {self.limits}" if self.limits else size


EXACT = Precision(0.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class Format:
    """A file format of splats.

    Attributes:
        name: Its name.
        suffix: How its files end.
        writes: Whether mi-splat writes it.
        degree: Largest SH degree that it holds.
        means: Precision of the means.
        scales: Of the logarithms of the standard deviations.
        rotations: Of the rotations.
        opacities: Of the opacities.
        colours: Of the sRGB colour 0.5 + C0 dc that the first SH coefficient stands for.
        sh: Of the other SH coefficients.
        order: Whether the Gaussians stay in their order.
    """

    name: str
    suffix: str
    writes: bool = True
    degree: int = 3
    means: Precision = EXACT
    scales: Precision = EXACT
    rotations: Precision = EXACT
    opacities: Precision = EXACT
    colours: Precision = EXACT
    sh: Precision = EXACT
    order: bool = True


_LOG = "of the logarithm"
_BYTE = Precision(0.5 / 255, "of opacity")

FORMATS: tuple[Format, ...] = (
    Format(
        name="3DGS PLY",
        suffix=".ply",
        scales=Precision(8e-6, _LOG),
        opacities=Precision(8e-6, "of opacity"),
    ),
    Format(name="glTF", suffix=".glb"),
    Format(name="OpenUSD", suffix=".usdc"),
    Format(
        name="compressed PLY",
        suffix=".compressed.ply",
        means=Precision(0.5 / 1023, "of the extent of its chunk"),
        scales=Precision(0.5 / 1023, "of the range in its chunk"),
        rotations=Precision(0.3, "degrees"),
        opacities=_BYTE,
        colours=Precision(0.5 / 255, "of the range in its chunk"),
        sh=Precision(1 / 32, "of a coefficient", "-4 to 4"),
        order=False,
    ),
    Format(
        name="SOG",
        suffix=".sog",
        means=Precision(0.5 / 65535, "of the extent, in sign(x) ln(1 + abs(x))"),
        scales=Precision(1 / 254, "of their range"),
        rotations=Precision(1.1, "degrees"),
        opacities=_BYTE,
        colours=Precision(1 / 254, "of their range"),
        sh=Precision(1 / 254, "of their range"),
    ),
    Format(
        name="SPZ",
        suffix=".spz",
        means=Precision(2.0**-22, "of the largest coordinate or of 1"),
        scales=Precision(1 / 32, _LOG, "-10 to 5.94"),
        rotations=Precision(0.3, "degrees"),
        opacities=_BYTE,
        colours=Precision(0.0037, "of full colour", "-0.44 to 1.44"),
        sh=Precision(1 / 256, "of a coefficient", "-1 to 0.99"),
    ),
    Format(
        name="splat",
        suffix=".splat",
        degree=0,
        rotations=Precision(0.9, "degrees"),
        opacities=_BYTE,
        colours=Precision(0.5 / 255, "of full colour", "0 to 1"),
    ),
    Format(
        name="ksplat",
        suffix=".ksplat",
        writes=False,
    ),
)
"""All formats, the most precise first; `ksplat` is read as it is, so that its precision is that of its writer."""

BY_SUFFIX = {entry.suffix: entry for entry in FORMATS}
"""The formats by how their files end."""


def markdown() -> str:
    """The table as docs/formats.md shows it."""
    columns = ("means", "scales", "rotations", "opacities", "colours", "sh")
    titles = ("ends in", "written", "SH degree", "means", "log-scales", "rotations", "opacity", "colour", "SH", "order")
    lines = [f"| {' | '.join(titles)} |", "|" + "---|" * len(titles)]
    for entry in FORMATS:
        kept = [str(getattr(entry, name)) if entry.writes else "as written" for name in columns]
        if not entry.degree:
            kept[-1] = "none"
        start = [f"`{entry.suffix}`", "yes" if entry.writes else "no", f"0 to {entry.degree}" if entry.degree else "0"]
        lines.append(f"| {' | '.join([*start, *kept, 'kept' if entry.order else 'changed'])} |")
    return "\n".join(lines) + "\n"
