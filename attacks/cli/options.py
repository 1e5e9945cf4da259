"""What the options of several commands take; light, so that --help is fast."""

from __future__ import annotations

from typing import Annotated

from mi_splat.cli.flags import Flag
from mi_splat.fields import Called, Fraction, above, at_least, between

Detectors = Annotated[tuple[str, ...], Called("DETECTOR")]
OneDetector = Annotated[str, Flag(name="detectors"), Called("DETECTOR")]
"""A detector of a command that takes one; the flag is called as where there may be several."""
ClassName = Annotated[str, Called("CLASS")]
Confidence = Annotated[Fraction, Called("CONFIDENCE")]
PositiveRadius = Annotated[float, above(0, "units of the splat file", "5 is the paper's"), Called("RADIUS")]
Seeds = Annotated[int, at_least(1), Called("COUNT")]
Groups = Annotated[tuple[str, ...], Called("TABLE")]
Processes = Annotated[int, between(0, 1024)]
Threads = Annotated[int, between(1, 1024)]
