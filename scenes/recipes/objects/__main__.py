"""Writes GLB files: `python -m scenes.recipes.objects` those that are shipped.

`python -m scenes.recipes.objects car --seed 7 --colour 0.1 0.2 0.5 --out blue.glb`
writes one of any seed and, of a car or a fire hydrant, of any colour (sRGB).
"""

import argparse
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from mi_splat.capture.mesh import Asset
from scenes.recipes.objects import BUILDERS, build, textures
from scenes.recipes.objects.examples import SEED, car_street, roadside
from scenes.recipes.objects.glb import glb_of
from scenes.recipes.objects.primitives import quad

ROOT = Path(__file__).resolve().parents[3]
IN_WHEEL = ROOT / "mi_splat" / "capture" / "objects"
TEXTURES = ROOT / "attacks" / "cloak" / "textures"
OTHERS = ROOT / "scenes" / "objects"
"""Objects of single studies."""

_PAINTS = {
    "black_car": (0.07, 0.07, 0.08),
    "blue_car": (0.08, 0.2, 0.52),
    "white_car": (0.92, 0.92, 0.9),
}
_OF_STUDIES = (
    ("car", 900007),
    ("car", 900012),
    ("car", 900014),
    ("car", 900019),
    ("car", 900024),
    ("car", 900033),
    ("fire hydrant", 900022),
    ("elephant", 0),
    ("stop sign", 0),
    ("suitcase", 4),
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Shipped:
    """A file and how its object is made."""

    file: Path
    make: Callable[[], Asset]
    exact: bool = True  # whether its textures are kept to the bit

    def data(self) -> bytes:
        """The bytes of the file."""
        return glb_of(self.make(), exact=self.exact)


def shipped() -> list[Shipped]:
    """Every file that is shipped."""
    make: Callable[[], Asset]
    files = [
        Shipped(file=_path(IN_WHEEL, name), make=partial(_alone, name, SEED))
        for name in BUILDERS
    ]
    for name, seed in _OF_STUDIES:
        file = _path(OTHERS, f"{name} {seed}")
        files.append(Shipped(file=file, make=partial(_alone, name, seed)))
    for name, colour in _PAINTS.items():
        make = partial(build, "car", SEED, colour=colour)
        files.append(Shipped(file=_path(OTHERS, name), make=make))
    for name in ("clock", "football", "stop_sign"):
        make = partial(_poster, name)
        files.append(Shipped(file=_path(TEXTURES, name), make=make))
    # of surroundings 8 bits do: with floats they would be four times as large
    surroundings = {"street": car_street, "roadside": roadside}
    for name, scene in surroundings.items():
        make = partial(_second, scene)
        files.append(Shipped(file=_path(IN_WHEEL, name), make=make, exact=False))
    sign = Shipped(file=_path(IN_WHEEL, "roadside sign"), make=lambda: roadside()[0])
    return [*files, sign]


def _second(scene: Callable[[], tuple[Asset, Asset]]) -> Asset:
    return scene()[1]


def _alone(name: str, seed: int) -> Asset:
    return build(name, seed).body


def _poster(name: str) -> Asset:
    """A square, a metre wide, that shows a texture."""
    texture = getattr(textures, name)()
    corners = [(0, -0.5, -0.5), (0, 0.5, -0.5), (0, 0.5, 0.5), (0, -0.5, 0.5)]
    return Asset(name, (quad(corners, texture),))


def _path(folder: Path, name: str) -> Path:
    return folder / f"{name.replace(' ', '_')}.glb"


def main() -> None:
    """Write one file, or all that are shipped."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("name", nargs="?", choices=tuple(BUILDERS))
    parser.add_argument("--seed", type=int, default=SEED)
    parser.add_argument("--colour", type=float, nargs=3, metavar="SRGB")
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    if options.name is None:
        for one in shipped():
            one.file.parent.mkdir(exist_ok=True)
            one.file.write_bytes(one.data())
        return
    made = build(options.name, options.seed, colour=options.colour)
    file = options.out or Path(f"{options.name}_{options.seed}.glb".replace(" ", "_"))
    file.write_bytes(glb_of(made.body))


if __name__ == "__main__":
    main()
