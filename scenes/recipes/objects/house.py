"""Houses that stand alone."""

import numpy as np

from mi_splat.capture.mesh import rotation, translation
from scenes.recipes.objects.model import Model
from scenes.recipes.objects.street import house


def build(seed: int = 0) -> Model:
    """A house 5 to 12 m wide whose front faces +x."""
    rng = np.random.default_rng([seed, 0x405E])
    alone = Model("house", tuple(house(rng, width=rng.uniform(5, 12))))
    (x0, y0, _), (x1, y1, _) = alone.bounds.tolist()
    return alone.transformed(
        rotation("z", 90) @ translation(-(x0 + x1) / 2, -(y0 + y1) / 2, 0)
    )
