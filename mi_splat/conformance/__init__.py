"""Whether a renderer makes the image of 3D Gaussian Splatting, and what it does
differently; imports nothing but NumPy.

A `ConformanceScene` is a small splat whose image shows one fact of the definition in
`mi_splat.oracle`. A `Deviation` is one thing that renderers and readers do differently,
and a profile a set of them that is meant. `compare` judges images and names the
deviations that explain them, `compare_gradients` does so with gradients, and
`assert_renders_like_3dgs` is for tests. All of it is published as `splat-conformance`,
too, for renderers that do not want the rest of mi-splat.
"""

from mi_splat.conformance.capabilities import CAPABILITIES, Capability
from mi_splat.conformance.causes import Cause, find_causes
from mi_splat.conformance.comparison import Report, SceneResult, compare
from mi_splat.conformance.deviations import DEVIATIONS, PROFILES, Deviation
from mi_splat.conformance.gradients import GradientReport, compare_gradients, weights
from mi_splat.conformance.scenes import SIZES, ConformanceScene, conformance_scenes
from mi_splat.conformance.setups import Setup, look_at
from mi_splat.conformance.testing import assert_renders_like_3dgs, random_splat
from mi_splat.conformance.tolerances import Error, Tolerance

__all__ = [
    "CAPABILITIES",
    "DEVIATIONS",
    "PROFILES",
    "SIZES",
    "Capability",
    "Cause",
    "ConformanceScene",
    "Deviation",
    "Error",
    "GradientReport",
    "Report",
    "SceneResult",
    "Setup",
    "Tolerance",
    "assert_renders_like_3dgs",
    "compare",
    "compare_gradients",
    "conformance_scenes",
    "find_causes",
    "look_at",
    "random_splat",
    "weights",
]
