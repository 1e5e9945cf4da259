"""Training of splats from views: the recipe of 3D Gaussian Splatting (Kerbl et al. 2023), whatever renders.

A run is a value (`TrainState`) that is advanced a step at a time, so that it can be saved and taken up again to the
bit. The order of the views, the children of splits and the noise of MCMC all come from one seeded generator.
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
from mi_splat.training.losses import photometric_loss
from mi_splat.training.state import Progress, TrainingError, TrainState
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


__all__ = ["Fit", "FitConfig", "Progress", "TrainState", "TrainingError", "advance", "extent_of", "fit"]

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
        render: Any differentiable renderer; the classic densification needs the one that fills `screen_gradients`, see
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
    state = TrainState(start, config, extent=extent_of(views), seed=seed)
    return advance(state, views, render=render, held_out=held_out, lpips=lpips, on_step=on_step)


def advance(
    state: TrainState,
    views: Sequence[View],
    *,
    render: RenderFn,
    held_out: Sequence[View] = (),
    lpips: Perceptual | None = None,
    on_step: OnStep | None = None,
) -> Fit:
    """Take a run to its end; `on_step` may stop it between two steps by raising."""
    config = state.config
    screen_gradients = getattr(render, "screen_gradients", None)
    if isinstance(config.densification, ClassicConfig) and screen_gradients is None:
        raise InvalidValueError(
            message(
                "render",
                "a renderer that watches centres",
                type(render).__name__,
                "use Renderer(screen_gradients=ScreenGradients())",
            )
        )
    while state.iteration < config.iterations:
        loss = _step(state, views[state.next_view(len(views))], render)
        if screen_gradients is not None and isinstance(config.densification, ClassicConfig):
            state.gradient += screen_gradients.lengths
            state.visits += screen_gradients.visible
        _after(state)
        scored = None
        every = config.eval_interval
        if state.iteration == config.iterations or (every and state.iteration % every == 0):
            scored = score(state.result(), held_out, render, lpips=lpips)
        line = Progress(iteration=state.iteration, loss=loss, count=len(state.gradient), held_out=scored)
        if state.iteration == config.iterations or scored is not None:
            state.history.append(line)
        if on_step is not None:
            on_step(line)
    return Fit(scene=state.result(), history=tuple(state.history), config=config, seed=state.seed)


def _step(state: TrainState, view: View, render: RenderFn) -> float:
    """One picture, its loss, its gradient, and a step of Adam."""
    config = state.config
    scene = state.scene()
    image = render(scene, view.camera)
    loss = photometric_loss(image, view.image, lambda_dssim=config.lambda_dssim)
    if isinstance(config.densification, MCMCConfig):
        loss = loss + config.densification.opacity_reg * scene.opacities.mean()
        loss = loss + config.densification.scale_reg * scene.scales.mean()
    state.optimiser.zero_grad(set_to_none=True)
    loss.backward()  # type: ignore[no-untyped-call]
    value = float(loss.detach())
    if not math.isfinite(value):
        raise TrainingError(_not_finite(state, value))
    rates = state.rates()
    for group in state.optimiser.param_groups:
        group["lr"] = rates[group["name"]]
    state.optimiser.step()
    state.iteration += 1
    return value


def _after(state: TrainState) -> None:
    """Add, remove, reset and shake, where the recipe has it at this step."""
    config, step = state.config.densification, state.iteration
    if config is None or step == state.config.iterations:  # what is changed last is trained no more
        return
    due = config.densify_from < step <= config.densify_until and step % config.densify_interval == 0
    if isinstance(config, MCMCConfig):
        if due:
            state.apply(strategies.relocate(state.parameters, config=config, generator=state.generator))
        with torch.no_grad():
            rate = state.rates()["means"]
            moved = strategies.explore(state.parameters, rate=rate, config=config, generator=state.generator)
            state.parameters["means"].copy_(moved)
        return
    if due:
        mean = state.gradient / state.visits.clamp(min=1)
        edit = strategies.classic(
            state.parameters,
            mean,
            extent=state.extent,
            config=config,
            was_reset=state.was_reset,
            generator=state.generator,
        )
        state.apply(edit)
    if config.opacity_reset_interval and step % config.opacity_reset_interval == 0 and step <= config.densify_until:
        _reset(state)


def _reset(state: TrainState) -> None:
    """Lower all opacities, and forget what Adam knows of them."""
    with torch.no_grad():
        state.parameters["opacities"].copy_(strategies.reset_opacities(state.parameters["opacities"]))
    adam = state.optimiser.state.get(state.parameters["opacities"])
    if adam:
        for key in ("exp_avg", "exp_avg_sq"):
            adam[key].zero_()
    state.was_reset = True


def _not_finite(state: TrainState, value: float) -> str:
    bad = [name for name, tensor in state.parameters.items() if not bool(torch.isfinite(tensor).all())]
    cause = f"not finite: {', '.join(bad)}" if bad else "the parameters are finite, the picture or the view is not"
    return message(
        f"loss at step {state.iteration}", "a finite number", f"{value} ({cause})", "look at views and rates"
    )
