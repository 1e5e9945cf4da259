"""Draws docs/images/six_pairs.png: `python docs/figures/six_pairs.py`.

The paper's six pairs of DAGGER with the settings of its text, from the scene's own
camera with seed 0: `fasterrcnn_small`, an l2 ball of radius 5 over the SH of the
object, eleven steps. The first column is the clean object. Titles give the confidence
of the target class and of the own class of the object.
"""

from pathlib import Path

import numpy as np
from matplotlib import pyplot as plt
from numpy.typing import NDArray

from attacks import DaggerConfig, attack, load_detector, relabel
from attacks.dagger.report import before_and_after
from attacks.dagger.result import JudgedView
from mi_splat import Renderer, read_scene

HERE = Path(__file__).resolve().parent
OUT = HERE.parent / "images" / "six_pairs.png"
PAIRS = {
    ("scenes/car_street.xml", "car"): ("person", "elephant", "stop sign"),
    ("scenes/stop_sign.xml", "stop_sign"): ("tv", "train", "bird"),
}


def attacked(scene: str, name: str, target: str) -> JudgedView:
    """The view of an attack with the paper's settings."""
    loaded = read_scene(scene)
    camera = next(iter(loaded.cameras.values()))
    result = attack(
        loaded.scene,
        loaded.objects[name],
        camera,
        load_detector("fasterrcnn_small"),
        relabel(target),
        render=Renderer(loaded.settings),
        config=DaggerConfig(),
    )
    (view,) = result.views
    return view


def halves(view: JudgedView) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """The clean and the attacked image with their boxes."""
    both = before_and_after(view)
    middle = both.shape[1] // 2
    return both[:, :middle], both[:, middle:]


def main() -> None:
    """Write the figure."""
    plt.style.use(HERE / "page.mplstyle")
    figure, rows = plt.subplots(2, 4, figsize=(7.2, 3.9), layout="constrained")
    for plots, ((scene, name), targets) in zip(rows, PAIRS.items(), strict=True):
        for plot, target in zip(plots[1:], targets, strict=True):
            view = attacked(scene, name, target)
            clean, after = halves(view)
            plot.imshow(after)
            own = name.replace("_", " ")
            reached = view.confidence(target, attacked=True)
            left = view.confidence(own, attacked=True)
            plot.set_title(f"{target} {reached:.0%}, {own} {left:.0%}")
        plots[0].imshow(clean)
        plots[0].set_title(f"clean: {own} {view.confidence(own, attacked=False):.0%}")
    for plot in rows.flat:
        plot.set(xticks=(), yticks=())
        plot.spines[:].set_visible(False)
    figure.savefig(OUT)


if __name__ == "__main__":
    main()
