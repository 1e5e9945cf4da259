"""What detectors report, as rows, and the rates that are counted from rows."""

from typing import Literal

Control = Literal["noise", "smooth-noise", "norm-noise"]
"""A random change of the object, beside which an attack is judged; also its name in the
column `splat` of rows.
"""
