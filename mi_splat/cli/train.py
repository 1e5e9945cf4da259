"""`mi-splat train`: a splat from images."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from mi_splat.cli.console import (
    UsageError,
    limit_threads,
    progress,
    show_result,
    warn,
)
from mi_splat.cli.flags import Positional, choice_among
from mi_splat.cli.options import Colour, JsonOptions
from mi_splat.errors import InvalidValueError, counted, nearest
from mi_splat.fields import (
    Folder,
    Length,
    Metavar,
    OutFolder,
    Seed,
    at_least,
    between,
)
from mi_splat.io.parsing import read_json
from mi_splat.training.config import FitConfig
from mi_splat.training.strategies import STRATEGIES, strategy_config, strategy_name

if TYPE_CHECKING:
    from mi_splat.datasets import Dataset
    from mi_splat.render.renderer import Renderer
    from mi_splat.scene import GaussianScene
    from mi_splat.training.loop import Progress, TrainState


EXAMPLES = (
    "train out/truck --out out/truck-splat --iterations 7000",
    "train YOUR_SET --out out/desk --downscale 2 --max-gaussians 200000",
    "train out/truck --out out/mcmc --strategy mcmc --max-gaussians 50000",
    "train RECEIVED --out out/splat --robust",
)

_STRATEGY = strategy_name(FitConfig().strategy)


@dataclass(frozen=True, kw_only=True)
class TrainOptions(JsonOptions):
    """Train a splat on images with cameras: a set of `mi-splat prepare` or `capture`,
    of COLMAP, or transforms.json.

    Lens distortion is removed, photographs are turned upright, and black pixels of the
    set's masks (mask_path of frames, or a folder masks/) are ignored.

    Writes splat.ply, metrics.json, config.json and checkpoint.safetensors into --out.
    Repeat the command to resume an interrupted run; the result is identical to that of
    an uninterrupted one. A finished run continues if --iterations is increased.
    """

    dataset: Positional[Folder]
    """Folder of the set."""
    out: OutFolder
    """Folder for the results; made if it is not there."""
    strategy: Annotated[str, Metavar("|".join(STRATEGIES))] = _STRATEGY
    """How Gaussians are added and removed: clone, split and prune (3DGS), MCMC
    relocation, or not at all. For the flags of one add --help.
    """
    fit: FitConfig = field(default_factory=FitConfig)
    """How the splat is trained."""
    renderer: Literal["tile", "ray"] = "tile"
    """Renderer: tile rasterises, ray traces rays (without the strategy classic)."""
    start: Path | None = None
    """Initial splat. Default: the point cloud of the set, or random Gaussians if it has
    none.
    """
    random: Annotated[int, between(1, 100_000_000, "Gaussians")] | None = None
    """Number of random Gaussians to initialise with instead."""
    downscale: Annotated[int, between(1, 64, "times smaller"), Metavar("FACTOR")] = 1
    """Integer factor by which the images are downscaled."""
    background: Colour = (0.0, 0.0, 0.0)
    """Colour behind the splat and transparent pixels, as white, #80b0e0 or
    0.5,0.7,0.9.
    """
    near: Length | None = None
    """Near plane: Gaussians nearer to a camera than this are not drawn, world units.
    Default: 0.2 as in 3DGS, or less if the scene or the distance of its cameras is
    small.
    """
    device: Literal["cpu", "cuda"] = "cpu"
    """Device for training: the CPU or an NVIDIA GPU."""
    keep: Literal["best", "last"] = "best"
    """Which step's splat is written: the best evaluation on the held-out images, which
    matters where few photographs overfit, or the last.
    """
    trust: Literal["A", "B"] | None = None
    """Audit the images first, and train without the group that is not named here: A is
    the larger of two groups that contradict each other, B the smaller. Where no groups
    do, all are used. See `mi-splat audit SET`.
    """
    robust: bool = False
    """As --trust A, but stop with exit status 3 where the two groups are nearly equal.
    """
    leave_out: tuple[str, ...] = ()
    """Names of images that are not used, as `mi-splat audit SET` gives them."""
    checkpoint_every: Annotated[int, at_least(1, "steps", "1000 is usual")] = 1000
    """Steps between checkpoints."""
    seed: Seed = 0
    """Seed of everything random."""


def defaults(words: Sequence[str]) -> dict[str, Any]:
    """The strategy and its options, which say what further flags there are."""
    name = choice_among(STRATEGIES, words, "--strategy", _STRATEGY)
    fit = FitConfig(
        strategy=strategy_config(name),
        coarse_until=COARSE_UNTIL,
        eval_interval=EVAL_INTERVAL,
    )
    return {"strategy": name, "fit": fit}


COARSE_UNTIL = 0.5
"""Share of the steps that look at smaller images: photographs take half the time, and
end as well (see docs/performance.md).
"""
EVAL_INTERVAL = 500
"""Steps between two evaluations, of which the best is kept."""
UNTRUSTED = 3
"""Exit status where the images fall into two groups of nearly one size."""
FEW_VIEWS = 10
"""Training views below which a splat is warned of."""
RANDOM_START = 10_000
"""Gaussians of a start without points."""
CULLED = 0.001
"""Share of the Gaussians from which it is said that the near plane hides them."""


def run(options: TrainOptions) -> int:
    """Train, or go on with a training, and say what came of it."""
    from mi_splat.io.folders import own_folder
    from mi_splat.render.variant import check_device
    from mi_splat.training.resume import CHECKPOINT, CONFIG

    check_device(options.device)
    left_out = _left_out(options)
    if left_out is None:
        return UNTRUSTED
    with own_folder(options.out, CONFIG, CHECKPOINT):
        _train(options, left_out)
    return 0


def _left_out(options: TrainOptions) -> frozenset[Path] | None:
    """The files of the images that are not used; None where the images fall into groups
    of which neither can be trusted.
    """
    if options.robust and options.trust is not None:
        raise UsageError.of(
            "--robust", "no --trust", f"--trust {options.trust}", "leave one out"
        )
    if not (options.robust or options.trust or options.leave_out):
        return frozenset()
    from mi_splat.audit.image_files import image_names, summary_of
    from mi_splat.audit.images import audit_images
    from mi_splat.datasets import load_dataset

    views = load_dataset(options.dataset, split=None)
    paths = dict(zip(image_names(views), views.paths, strict=True))
    for name in options.leave_out:
        if name not in paths:
            do = nearest(name, tuple(paths), "see the names in `mi-splat audit SET`")
            raise UsageError.of("--leave-out", "an image of the set", name, do)
    left_out = {paths[name] for name in options.leave_out}
    if options.robust or options.trust:
        with progress("comparing the images"):
            audit = audit_images(views)
        warn("; ".join(summary_of(audit, tuple(paths))))
        if options.robust and audit.is_nearly_equal:
            return None
        dropped = audit.left_out(options.trust or "A").nonzero()[:, 0]
        left_out |= {views.paths[number] for number in dropped.tolist()}
    return frozenset(left_out)


def _train(options: TrainOptions, left_out: frozenset[Path]) -> None:
    from mi_splat.cameras.framing import near_plane
    from mi_splat.datasets import load_dataset
    from mi_splat.training.resume import train

    limit_threads(1)
    config = options.fit
    with progress("loading the images"):
        load = partial(
            load_dataset,
            options.dataset,
            downscale=options.downscale,
            background=options.background,
        )
        views = load(split="train").without(left_out)
        held_out = load(split="test").without(left_out)
        if not len(views):
            do = "trust the other group, or leave fewer images out"
            raise InvalidValueError.of(
                str(options.dataset), "images to train on", "none that is left", do
            )
        _say_of_images(options.dataset, views, held_out)
        start = _start(views, options)
        if options.near is None:
            near = near_plane(start, views.cameras)
        else:
            near = options.near
        render = _renderer(options, near)
        settings: dict[str, object] = {
            "near": near,
            "background": list(options.background),
            "device": options.device,
            "renderer": options.renderer,
        }
        if left_out:
            settings["left_out"] = sorted(path.name for path in left_out)
    _warn_of_culled(start, views, near)
    begun = time.monotonic()
    held_out_score = ""
    pace = _Pace(config.iterations, options.downscale)
    with progress("training", total=config.iterations) as advance:

        def on_resume(state: TrainState) -> None:
            whole = (
                f"the run has all its {config.iterations:,} steps; only its results are"
                " written again"
            )
            rest = f"going on from step {state.iteration:,} of {config.iterations:,}"
            warn(whole if state.iteration >= config.iterations else rest)
            advance("training", state.iteration)
            pace.resume()

        def on_step(step: Progress) -> None:
            nonlocal held_out_score
            pace.count(step.iteration)
            if step.held_out is not None:
                held_out_score = f", held out {step.held_out.psnr:.2f} dB"
            advance(f"loss {step.loss:.4f}, {step.count:,} Gaussians{held_out_score}")

        trained = train(
            views,
            start.to(options.device),
            options.out,
            render=render,
            config=config,
            seed=options.seed,
            held_out=held_out,
            every=options.checkpoint_every,
            keep=options.keep,
            settings=settings,
            dataset=options.dataset,
            on_resume=on_resume,
            on_step=on_step,
        )
    _show(options, len(trained.scene), time.monotonic() - begun)


def _say_of_images(source: Path, views: Dataset, held_out: Dataset) -> None:
    """Say how many images the set lists and has, and warn of few."""
    from mi_splat.datasets.folders import unlisted_images

    listed = views.listed | held_out.listed
    there = len(views) + len(held_out)
    split = f"{counted(len(views), 'image')} for training, {len(held_out)} held out"
    masked = sum(frame.mask is not None for frame in views.frames)
    warn(
        f"{source}: {there} of {counted(len(listed), 'listed image')} there; {split};"
        f" {masked} with a mask"
    )
    others = unlisted_images(listed)
    if others:
        do = "find the cameras of the others with `mi-splat prepare`"
        warn(
            f"{len(listed)} of {len(listed) + others} images in {source} have a camera;"
            f" {do}"
        )
    if len(views) < FEW_VIEWS:
        warn(
            f"{counted(len(views), 'training view')} only: 20 to 200 are usual; the"
            " splat will be poor elsewhere"
        )


class _Pace:
    """Says once how long a training will take, and what helps where it is long."""

    WARM_UP = 5
    WORTH_SAYING = 10.0
    """Steps that compile and are not counted; seconds after which it is said."""

    def __init__(self, iterations: int, downscale: int) -> None:
        self._iterations = iterations
        self._downscale = downscale
        self._left = self.WARM_UP
        self._began = 0.0
        self._steps = 0
        self._is_said = False

    def resume(self) -> None:
        """Begin to count again."""
        self._left = self.WARM_UP

    def count(self, iteration: int) -> None:
        """Count a step."""
        now = time.monotonic()
        if self._left:
            self._left -= 1
            self._began = now
            return
        self._steps += 1
        if self._is_said or now - self._began < self.WORTH_SAYING:
            return
        self._is_said = True
        each = (now - self._began) / self._steps
        rest = each * (self._iterations - iteration)
        text = (
            f"a step takes {each:.2g} s: about {max(1, round(rest / 60))} min left at"
            " this pace"
        )
        if each > 1:
            text += (
                f"; --downscale {self._downscale * math.ceil(math.sqrt(each))} is"
                " faster"
            )
        warn(text)


def _show(options: TrainOptions, count: int, seconds: float) -> None:
    from mi_splat.training.resume import METRICS, SPLAT

    figures = read_json(options.out / METRICS)
    lines = [
        f"{options.out / SPLAT}: {count:,} Gaussians after {options.fit.iterations}"
        " steps"
    ]
    if figures["psnr"] is not None:
        quality = f"PSNR {figures['psnr']:.2f} dB, SSIM {figures['ssim']:.4f}"
        lines.append(f"held out ({figures['held_out_views']} images): {quality}")
    if figures["kept_iteration"] < options.fit.iterations:
        last = figures["history"][-1]["held_out"]["psnr"]
        lines.append(
            f"step {figures['kept_iteration']:,} was kept, the best on held-out images;"
            f" after the last step they have {last:.2f} dB (--keep last)"
        )
    lines.append(f"took {seconds:.0f} s; figures are in {options.out / METRICS}")
    show_result(
        {**figures, "out": str(options.out), "seconds": seconds},
        *lines,
        as_json=options.json,
    )


def _renderer(options: TrainOptions, near: float) -> Renderer:
    from mi_splat.render.renderer import Renderer, RenderSettings, ScreenGradients

    config = options.fit
    variant = "cuda_ad_rgb" if options.device == "cuda" else ""
    settings = RenderSettings(
        method=options.renderer,
        background=options.background,
        near=near,
        variant=variant,
    )
    return Renderer(
        settings,
        screen_gradients=(
            ScreenGradients() if config.strategy.needs_screen_gradients else None
        ),
    )


def _warn_of_culled(start: GaussianScene, views: Dataset, near: float) -> None:
    """Say how much of the start no image will show, if it is worth a word."""
    from mi_splat.cameras.framing import culled_in_view

    culled = [culled_in_view(start, camera, near) for camera in views.cameras]
    if max(culled) > CULLED * len(start):
        most = f"{max(culled):,} of {len(start):,} Gaussians"
        warn(
            f"in {sum(map(bool, culled))} of {len(culled)} images, up to {most} are"
            f" nearer than near = {near:g}"
        )


def _start(views: Dataset, options: TrainOptions) -> GaussianScene:
    from mi_splat.io import load_splat
    from mi_splat.training.initialization import from_points, random_points, thinned

    if options.fit.strategy.adds_gaussians:
        limit = options.fit.strategy.max_gaussians
    else:
        limit = None
    if options.start is not None and options.random is not None:
        raise InvalidValueError.of(
            "--random", "no other start", f"--start {options.start}", "leave one out"
        )
    if options.start is not None:
        return load_splat(options.start)
    if options.random is not None:
        return random_points(views, options.random, seed=options.seed)
    if views.points is None or not len(views.points):
        count = RANDOM_START if limit is None else min(limit, RANDOM_START)
        warn(
            f"the set has no points: starting on {count:,} Gaussians anywhere (see"
            " --random, --start)"
        )
        return random_points(views, count, seed=options.seed)
    cloud = views.points
    if limit is not None and len(cloud.points) > limit:
        warn(
            f"starting on {limit:,} of {len(cloud.points):,} points, evenly at random:"
            " no more are allowed"
        )
        cloud = thinned(cloud, limit, seed=options.seed)
    return from_points(cloud.points, cloud.colours)
