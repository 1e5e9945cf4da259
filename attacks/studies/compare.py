"""Studies of renderers: what `mi-splat compare` measures, with one thing changed at a
time.

Settings of `study = "compare"` are the fields of `Comparing`. Every point is a job of
its own.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import polars as pl

from attacks.figures.frame import Figures
from attacks.figures.rate import number
from attacks.figures.tables import Table
from attacks.studies.attack import scene_files
from attacks.studies.running import Attempt, Observed, Work, copied, names_of
from attacks.studies.study_file import Point, Study, with_none
from mi_splat.attributes import ATTRIBUTES
from mi_splat.cli.cameras import ALL, find_cameras, renderer_of
from mi_splat.cli.options import CameraOptions
from mi_splat.comparison.compare import (
    FORWARD,
    GRADIENT,
    CompareConfig,
    Comparison,
    as_dict,
    compare,
    save_sheets,
)
from mi_splat.comparison.methods import FOLDER, load_methods
from mi_splat.datasets.frames import Split
from mi_splat.fields import Checked, decode
from mi_splat.io.camera_records import OF, describe
from mi_splat.io.documents import save_json
from mi_splat.io.folders import RECORD
from mi_splat.io.parsing import read_json
from mi_splat.ledger import Done, Job
from mi_splat.ledger.job import Out
from mi_splat.ledger.plans import Result
from mi_splat.render.scene_files import (
    MixedScene,
    SplatScene,
    holds_surfaces,
    open_scene,
)
from mi_splat.scene import scene_hash

VARIES = (RECORD,)
_COSTS = {"image": FORWARD, "image and gradient": GRADIENT}


@dataclass(frozen=True, slots=True, kw_only=True)
class Comparing(Checked):
    """A splat, what renders it, and from where."""

    scene: str  # splat file, or scene XML, also with meshes
    # as `mi-splat compare` calls them; with meshes, path-traced-N, too
    methods: tuple[str, ...]
    view: CameraOptions = field(default_factory=CameraOptions)
    # in place of default values of a scene with meshes
    parameters: Mapping[str, float] = field(default_factory=dict)
    config: CompareConfig = field(default_factory=CompareConfig)


def measured(
    config: Comparing, on_step: Callable[[str], None], *, split: Split | None = None
) -> tuple[Comparison, dict[str, Any]]:
    """A comparison, and what a result says of it; of a data set the cameras of one
    split, or all.
    """
    path = Path(config.scene)
    makes_meshes = None
    if holds_surfaces(path):

        def makes_meshes(samples: int) -> MixedScene:
            parameters: Mapping[str, Any] = config.parameters
            return MixedScene(path, samples=samples, seed=samples, **parameters)

    loaded = _splats(config)
    cameras = find_cameras(loaded, config.view, split=split)
    settings = renderer_of(loaded, config.view, cameras).settings
    methods = load_methods(config.methods, settings, cameras, meshes=makes_meshes)
    comparison = compare(
        loaded.scene, cameras, methods, config=config.config, on_step=on_step
    )
    return comparison, {
        "scene": config.scene,
        "scene_hash": scene_hash(loaded.scene),
        "gaussians": len(loaded.scene),
        "given": list(config.methods),
        "background": list(settings.background),
        "near": settings.near,
        **asdict(config.config),
        **as_dict(comparison, methods),
        "cameras": [describe(name, camera) for name, camera in cameras.items()],
    }


def _splats(config: Comparing) -> SplatScene:
    """The splats of a scene, also of one with meshes."""
    path = Path(config.scene)
    if holds_surfaces(path):
        parameters: Mapping[str, Any] = config.parameters
        return MixedScene(path, samples=1, **parameters).splats
    return open_scene(path)


def run(
    config: Comparing, inputs: Mapping[str, Path], out: Out
) -> list[dict[str, Any]]:
    """Compare, and write a record and a sheet for each camera."""
    comparison, record = measured(
        config, lambda text: out.progress(text, 0, 0), split="test"
    )
    save_sheets(comparison.pictures, out.files)
    save_json(record, out / RECORD)
    return []


def files_of(config: Comparing) -> dict[str, Path]:
    """The files that a comparison reads, as inputs of a job."""
    named = [
        Path(text.removeprefix(FOLDER))
        for text in config.methods
        if text.startswith(FOLDER)
    ]
    for text in config.view.cameras:
        source = text if Path(text).exists() else text.rpartition(OF)[0]
        # cameras come first
        named_so = Path(text).is_dir() and (
            text == ALL or text in _splats(config).cameras
        )
        if source and Path(source).exists() and not named_so:
            named.append(Path(source))
    files = [
        file
        for path in named
        for file in ([path] if path.is_file() else sorted(path.rglob("*.*")))
    ]
    if config.scene.endswith(".xml"):
        inputs = scene_files(Path(config.scene))
    else:
        inputs = {"scene": Path(config.scene)}
    return {**inputs, **{f"file {number}": file for number, file in enumerate(files)}}


class CompareWork(Work[Attempt]):
    """Comparisons."""

    story = "compare-study"
    has_evaluations = False

    def __init__(self, study: Study) -> None:
        super().__init__(study, map(self.attempt, study.points))

    def attempt(self, point: Point) -> Attempt:
        """One comparison."""
        config = decode(Comparing, with_none(point.settings), self.study.name)
        title = ": ".join(
            filter(None, (point.part, names_of(point, self.study.name)[1]))
        )
        job = Job(kind=__name__, config=config, inputs=files_of(config))
        return Attempt(point=point, title=title, jobs={title: job})

    def observed(self, results: Mapping[str, Result], out: Path) -> Observed:
        """The records by point, and a sheet of each."""
        done = {
            name: result for name, result in results.items() if isinstance(result, Done)
        }
        sheets = {
            name: min(result.folder.glob("*.png")) for name, result in done.items()
        }
        paths = [copied(file, out / "pictures", name) for name, file in sheets.items()]
        return (
            {
                "points": {
                    name: read_json(result.folder / RECORD)
                    for name, result in done.items()
                }
            },
            {},
            paths,
        )

    def figures(
        self, record: Mapping[str, Any], rows: Mapping[str, pl.DataFrame]
    ) -> Figures:
        """None: its record has all numbers, which no rows give."""
        return Figures({})

    def tables(self, record: Mapping[str, Any], figures: Figures) -> Iterator[Table]:
        """Errors, gradients and costs by point."""
        yield from tables(record["points"])


def tables(points: Mapping[str, Mapping[str, Any]]) -> Iterator[Table]:
    """Errors by point and camera, gradients and costs, a column for each pair or
    method.
    """
    pairs = dict.fromkeys(
        tuple(pair["methods"]) for point in points.values() for pair in point["pairs"]
    )
    methods = dict.fromkeys(
        name for point in points.values() for name in point["methods"]
    )
    errors = list[tuple[str, ...]]()
    gradients = list[tuple[str, ...]]()
    costs = list[tuple[str, ...]]()
    for title, point in points.items():
        found = {tuple(pair["methods"]): pair for pair in point["pairs"]}
        named = [camera["name"] for camera in point["cameras"]]
        by_name = {title: found} | {
            f"{title}, {name}": {
                pair: entry["by_camera"][name] for pair, entry in found.items()
            }
            for name in (named if len(named) > 1 else ())
        }
        errors += [
            (name, *(_error(seen.get(pair)) for pair in pairs))
            for name, seen in by_name.items()
        ]
        for name in (
            ATTRIBUTES if any(pair["gradients"] for pair in found.values()) else ()
        ):
            gradients.append(
                (
                    f"{title}, {name}",
                    *(_agreement(found.get(pair), name) for pair in pairs),
                )
            )
        for words, key in _COSTS.items():
            spent = [point["methods"].get(name, {}).get(key) for name in methods]
            if any(spent):
                costs.append((f"{title}, {words}", *map(_cost, spent)))
    head = ("setting", *(" and ".join(pair) for pair in pairs))
    yield Table(
        caption="Difference of images: PSNR, SSIM", head=head, rows=tuple(errors)
    )
    caption = "Gradients: cosine, length of the difference over that of the first"
    if gradients:
        yield Table(caption=caption, head=head, rows=tuple(gradients))
    caption = "Processor time, and its ratio to the first method"
    yield Table(caption=caption, head=("setting", *methods), rows=tuple(costs))


def _error(pair: Mapping[str, Any] | None) -> str:
    if pair is None:
        return "-"
    if pair["psnr"] is None:
        return "equal"
    return f"{number(pair['psnr'], unit='dB')}, {number(pair['ssim'], '.4f')}"


def _agreement(pair: Mapping[str, Any] | None, attribute: str) -> str:
    if pair is None or pair["gradients"] is None:
        return "-"
    found = pair["gradients"][attribute]
    if found["cosine"] is None:
        return "no gradient, or not finite"
    return ", ".join(number(found[key], ".3f") for key in ("cosine", "relative_error"))


def _cost(cost: Mapping[str, float] | None) -> str:
    if cost is None:
        return "-"
    return f"{number(cost['seconds'], '.3f', 's')}, {number(cost['ratio'], '.2f')}"
