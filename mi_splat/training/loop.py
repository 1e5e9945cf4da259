"""Training of splats from views: the recipe of 3D Gaussian Splatting (Kerbl et al. 2023), whatever renders.

A run is a value (`Run`) that is advanced a step at a time, so that it can be saved and taken up again to the bit. The
order of the views, the children of splits and the noise of MCMC all come from one seeded generator.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch

from mi_splat.cameras import RenderFn, View, cameras_of
from mi_splat.errors import InvalidValueError, message
from mi_splat.metrics import Perceptual
from mi_splat.scene import GaussianScene
from mi_splat.training import strategies
from mi_splat.training.config import FitConfig
from mi_splat.training.evaluation import score
from mi_splat.training.losses import photometric
from mi_splat.training.state import Progress, Run, TrainingError
from mi_splat.training.strategies import ClassicConfig, MCMCConfig


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Fit:
    """A trained splat.

    Attributes:
        scene: The result.
        history: Every evaluation, the last step's included.
        config: The full configuration.
        seed: The seed.
    """

    scene: GaussianScene
    history: tuple[Progress, ...]
    config: FitConfig
    seed: int


__all__ = ["Fit", "FitConfig", "Progress", "Run", "TrainingError", "advance", "extent_of", "fit"]

OnStep = Callable[[Progress], None]


def extent_of(views: Sequence[View]) -> float:
    """Size of what the cameras look at: 1.1 times the largest distance of one from their mean, world units."""
    positions = torch.stack([camera.position for camera in cameras_of(views)])
    return max(1.1 * float((positions - positions.mean(0)).norm(dim=1).max()), 1e-3)


def fit(
    views: Sequence[View],
    start: GaussianScene,
    *,
    render: RenderFn,
    config: FitConfig | None = None,
    seed: int = 0,
    held_out: Sequence[View] = (),
    lpips: Perceptual | None = None,
    on_step: OnStep | None = None,
) -> Fit:
    """Train a splat on views.

    Args:
        views: Pictures to match.
        start: Gaussians to begin with.
        render: Any differentiable renderer; the classic densification needs the one that fills `watch`, see
            `mi_splat.rendering.Renderer`.
        config: How; the shortened 3DGS recipe if None.
        seed: Seed of everything random.
        held_out: Views to score on that are not trained on.
        lpips: A further score, see `mi_splat.metrics.load_lpips`.
        on_step: Called after every step.

    Raises:
        InvalidValueError: There are no views or no Gaussians, or the renderer gives no statistics to densify by.
        TrainingError: A value is not finite, or every Gaussian was pruned.
    """
    config = config or FitConfig()
    if not len(views) or not len(start):
        raise InvalidValueError(
            message("views and start", "at least one of each", (len(views), len(start)), "capture views first")
        )
    run = Run(start, config, extent=extent_of(views), seed=seed)
    return advance(run, views, render=render, held_out=held_out, lpips=lpips, on_step=on_step)


def advance(
    run: Run,
    views: Sequence[View],
    *,
    render: RenderFn,
    held_out: Sequence[View] = (),
    lpips: Perceptual | None = None,
    on_step: OnStep | None = None,
) -> Fit:
    """Take a run to its end; `on_step` may stop it between two steps by raising."""
    config = run.config
    watch = getattr(render, "watch", None)
    if isinstance(config.densification, ClassicConfig) and watch is None:
        raise InvalidValueError(
            message("render", "a renderer that watches centres", type(render).__name__, "use Renderer(watch=Watch())")
        )
    while run.iteration < config.iterations:
        loss = _step(run, views[run.next_view(len(views))], render)
        if watch is not None and isinstance(config.densification, ClassicConfig):
            run.gradient += watch.lengths
            run.visits += watch.visible
        _after(run)
        scored = None
        every = config.evaluate_every
        if run.iteration == config.iterations or (every and run.iteration % every == 0):
            scored = score(run.result(), held_out, render, lpips=lpips)
        line = Progress(iteration=run.iteration, loss=loss, count=len(run.gradient), held_out=scored)
        if run.iteration == config.iterations or scored is not None:
            run.history.append(line)
        if on_step is not None:
            on_step(line)
    return Fit(scene=run.result(), history=tuple(run.history), config=config, seed=run.seed)


def _step(run: Run, view: View, render: RenderFn) -> float:
    """One picture, its loss, its gradient, and a step of Adam."""
    config = run.config
    scene = run.scene()
    image = render(scene, view.camera)
    loss = photometric(image, view.image, structure=config.structure)
    if isinstance(config.densification, MCMCConfig):
        loss = loss + config.densification.opacity_weight * scene.opacities.mean()
        loss = loss + config.densification.scale_weight * scene.scales.mean()
    run.optimiser.zero_grad(set_to_none=True)
    loss.backward()  # type: ignore[no-untyped-call]
    value = float(loss.detach())
    if not math.isfinite(value):
        raise TrainingError(_not_finite(run, value))
    rates = run.rates()
    for group in run.optimiser.param_groups:
        group["lr"] = rates[group["name"]]
    run.optimiser.step()
    run.iteration += 1
    return value


def _after(run: Run) -> None:
    """Add, remove, reset and shake, where the recipe has it at this step."""
    config, step = run.config.densification, run.iteration
    if config is None or step == run.config.iterations:  # what is changed last is trained no more
        return
    due = config.start < step <= config.stop and step % config.every == 0
    if isinstance(config, MCMCConfig):
        if due:
            run.apply(strategies.relocate(run.parameters, config=config, generator=run.generator))
        with torch.no_grad():
            rate = run.rates()["means"]
            moved = strategies.explore(run.parameters, rate=rate, config=config, generator=run.generator)
            run.parameters["means"].copy_(moved)
        return
    if due:
        mean = run.gradient / run.visits.clamp(min=1)
        edit = strategies.classic(
            run.parameters,
            mean,
            extent=run.extent,
            config=config,
            was_reset=run.was_reset,
            generator=run.generator,
        )
        run.apply(edit)
    if config.reset_every and step % config.reset_every == 0 and step <= config.stop:
        _reset(run)


def _reset(run: Run) -> None:
    """Lower all opacities, and forget what Adam knows of them."""
    with torch.no_grad():
        run.parameters["opacities"].copy_(strategies.reset_opacities(run.parameters["opacities"]))
    state = run.optimiser.state.get(run.parameters["opacities"])
    if state:
        for key in ("exp_avg", "exp_avg_sq"):
            state[key].zero_()
    run.was_reset = True


def _not_finite(run: Run, value: float) -> str:
    bad = [name for name, tensor in run.parameters.items() if not bool(torch.isfinite(tensor).all())]
    cause = f"not finite: {', '.join(bad)}" if bad else "the parameters are finite, the picture or the view is not"
    return message(f"loss at step {run.iteration}", "a finite number", f"{value} ({cause})", "look at views and rates")
