"""What there is to see of a file or of a folder with results, as an exhibit."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from attacks.cloak.study import SUMMARY
from attacks.viewing.studies import exhibit_of_study
from mi_splat.bounds import bounds
from mi_splat.directions import Point
from mi_splat.errors import InvalidValueError, MiSplatError, message
from mi_splat.io.camera_records import camera_of
from mi_splat.io.parsing import read_json
from mi_splat.rendering import RenderSettings
from mi_splat.scene import GaussianScene, scene_hash
from mi_splat.scene_files import open_scene
from mi_splat.viewer.exhibit import Exhibit, ShownSplat, exhibit_of_file
from mi_splat.viewer.lines import Lines, frustums
from mi_splat.viewer.orbit import orbit_of

RESULT, ATTACKED = "result.json", "attacked.ply"


def open_exhibit(path: Path, *, clean: Path | None = None) -> Exhibit:
    """A splat file, a scene XML, or a folder that `mi-splat dagger`, `dagger-eot` or `mi-splat cloak` has written.

    Args:
        path: The file or the folder.
        clean: Splat file or scene XML to compare with. Of a folder of `mi-splat dagger` it is found, if it lies among
            the scenes of the working folder; a folder of `mi-splat cloak` has its own.

    Raises:
        MiSplatError: It is none of these, a file in it is missing or broken, or the clean scene is not the one that was
            attacked.
    """
    if not path.is_dir():
        exhibit = exhibit_of_file(path, clean=clean)
        counts = [len(splat.scene) for splat in exhibit.splats]
        if len(set(counts)) > 1:
            got, do = f"{counts[0]:,} and {counts[1]:,}", "pass the scene that was attacked"
            raise InvalidValueError(message("the scenes", "the same Gaussians in both", got, do))
        return exhibit
    if (path / RESULT).is_file():
        return _exhibit_of_attack(path, clean)
    if (path / SUMMARY).is_file():
        if clean is not None:
            raise InvalidValueError(message("clean", "nothing, since a study has its own", clean, "leave it out"))
        return exhibit_of_study(path, read_json(path / SUMMARY))
    expected = f"{RESULT} (mi-splat dagger) or {SUMMARY} (mi-splat cloak) in it"
    raise InvalidValueError(message(str(path), expected, "neither", "pass a finished result, or a .ply or .xml file"))


def _exhibit_of_attack(folder: Path, clean: Path | None) -> Exhibit:
    """The clean and the attacked splat of a DAGGER result, from the cameras that were attacked or that judged it."""
    result = read_json(folder / RESULT)
    try:
        first = result["views"][0].get("detector")  # every detector looked from the same cameras
        views = [camera_of(view["camera"]) for view in result["views"] if view.get("detector") == first]
        expected, rendered = str(result["scene_hash"]), _rendered_with(result)
    except (KeyError, TypeError, ValueError, IndexError, AttributeError) as error:
        do = "make the result again with mi-splat dagger"
        raise InvalidValueError(message(str(folder / RESULT), "a result of DAGGER", repr(error), do)) from error
    path, settings, splat = _clean_scene(folder, expected, clean, recorded=result.get("scene"))
    attacked = open_scene(folder / ATTACKED).scene
    radius, middle = bounds(splat.scene)[1], middle_of_change(splat.scene, attacked)
    kind = "held-out" if "reference" in result else "attacked"
    found = {f"{kind} view {i}": orbit_of(camera, middle) for i, camera in enumerate(views)}
    cameras = {name: orbit for name, orbit in found.items() if orbit is not None}
    others = exhibit_of_file(path)
    exhibit = Exhibit(
        title=str(folder),
        splats=(
            splat,
            ShownSplat(name="attacked", scene=attacked, path=folder / ATTACKED, own=RenderSettings()),
        ),
        settings=replace(settings, **rendered),
        start=next(iter(cameras.values()), others.start),
        size=(views[0].width, views[0].height),
        cameras={**cameras, **others.cameras},
    )
    cone = Lines(segments=frustums(views, 0.1 * radius), colour="#ffa500")
    return replace(exhibit, lines={f"{kind.capitalize()} cameras": cone})


def _rendered_with(result: dict[str, Any]) -> dict[str, Any]:
    """Near plane and background of a result, for `RenderSettings`; nothing of an older one, which does not say them."""
    if "near" not in result or "background" not in result:
        return {}
    red, green, blue = map(float, result["background"])
    return {"near": float(result["near"]), "background": (red, green, blue)}


def middle_of_change(clean: GaussianScene, attacked: GaussianScene) -> Point:
    """(3,) mean of the Gaussians that an attack has changed, world units: the middle of the attacked object.

    Raises:
        InvalidValueError: The scenes have different numbers of Gaussians.
    """
    if len(clean) != len(attacked):
        do = "pass the scene that was attacked"
        raise InvalidValueError(message("attacked.ply", f"{len(clean)} Gaussians", len(attacked), do))
    degree = max(clean.degree, attacked.degree)
    pairs = zip(clean.with_degree(degree).tensors(), attacked.with_degree(degree).tensors(), strict=True)
    rows = [(before - after).abs().reshape(len(before), -1).amax(1) for before, after in pairs]
    changed = torch.stack(rows).amax(0) > 1e-4  # a file rounds
    if not bool(changed.any()):
        return bounds(clean)[0]
    x, y, z = clean.means[changed].double().mean(0).tolist()
    return x, y, z


def _clean_scene(
    folder: Path, expected: str, clean: Path | None, *, recorded: object
) -> tuple[Path, RenderSettings, ShownSplat]:
    """The scene with this hash: the one that is named, the one that the result names, or one of those near by."""
    named = [Path(recorded)] if isinstance(recorded, str) and Path(recorded).is_file() else []
    for path in [clean] if clean is not None else [*named, *_scenes_near(folder)]:
        try:
            loaded = open_scene(path)
        except MiSplatError:
            if clean is not None:
                raise
            continue
        if scene_hash(loaded.scene) == expected:
            splat = ShownSplat(name="clean", scene=loaded.scene, path=path, own=loaded.settings)
            return path, loaded.settings, splat
        if clean is not None:
            do = "pass the scene that was attacked"
            raise InvalidValueError(message(f"clean scene {clean}", f"the hash {expected}", "another", do))
    text = message(f"clean scene of {folder}", f"the hash {expected}", "no such scene here", "name the clean scene")
    raise InvalidValueError(text).hinted("--clean")


def _scenes_near(folder: Path) -> Iterator[Path]:
    """Scene files that may have been attacked: beside the result, and in the working folder and its `scenes`."""
    for place in (folder, folder.parent, Path(), Path("scenes")):
        yield from sorted(place.glob("*.xml"))
