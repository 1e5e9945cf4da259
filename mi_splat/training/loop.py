"""Training of splats from views: the recipe of 3D Gaussian Splatting (Kerbl et al.
2023), whatever renders.

A run is a value (`TrainState`) that is advanced a step at a time, so that it can be
saved and taken up again to the bit. The order of the views, the children of splits and
the noise of MCMC all come from one seeded generator.
"""

import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor

from mi_splat.cameras.camera import Camera, RenderFn, View, cameras_of
from mi_splat.errors import InvalidValueError
from mi_splat.scene import GaussianScene
from mi_splat.training.config import FitConfig
from mi_splat.training.evaluation import loss_mask_of, score
from mi_splat.training.losses import masked, photometric_loss
from mi_splat.training.state import Progress, TrainingError, TrainState, check_start
from mi_splat.training.strategies import ScreenGradients, Step


@dataclass(frozen=True, slots=True, eq=False, kw_only=True, repr=False)
class Fit:
    """A trained splat."""

    scene: GaussianScene  # the result
    history: tuple[Progress, ...]  # every evaluation, the last step's included
    config: FitConfig  # the full configuration
    seed: int  # the seed

    def __repr__(self) -> str:
        last = self.history[-1]
        if last.held_out is None:
            scores = ""
        else:
            scores = f", PSNR {last.held_out.psnr:.1f} dB held out"
        return (
            f"Fit({len(self.scene):,} Gaussians after {last.iteration} steps, loss"
            f" {last.loss:.3g}{scores})"
        )


__all__ = [
    "Fit",
    "FitConfig",
    "Progress",
    "TrainState",
    "TrainingError",
    "advance",
    "fit",
    "scene_extent",
]

LEAST_SIDE = 32
"""Pixels that a coarse image has at least on its shorter side."""

OnStep = Callable[[Progress], None]
Target = tuple[Camera, Tensor, Tensor | None]
"""A camera, its image, and the mask of what of it counts."""


def scene_extent(views: Sequence[View]) -> float:
    """Size of what the cameras look at: 1.1 times the largest distance of one from
    their mean, world units.
    """
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
    on_step: OnStep | None = None,
) -> Fit:
    """Train a splat on views.

    Args:
        views: Images to match; where they have masks
            (`mi_splat.datasets.Dataset.loss_mask`), what is masked does not count.
        start: Gaussians to begin with.
        render: Any differentiable renderer; the classic strategy needs one that keeps
            screen gradients, see `mi_splat.render.renderer.Renderer`.
        config: How; the shortened 3DGS recipe if None.
        seed: Seed of everything random.
        held_out: Views to score on that are not trained on.
        on_step: Called after every step.

    Returns:
        The splat, and how training went.

    Raises:
        InvalidValueError: There are no views or no Gaussians, or more of these than the
            strategy allows; the strategy needs screen gradients, and the renderer gives
            none.
        TrainingError: A value is not finite, or every Gaussian was pruned.
    """
    config = config or FitConfig()
    if not len(views):
        raise InvalidValueError.of(
            "views", "at least one", "none", "capture views first"
        )
    check_start(start, config)
    state = TrainState(start, config, scene_extent=scene_extent(views), seed=seed)
    return advance(state, views, render=render, held_out=held_out, on_step=on_step)


def advance(
    state: TrainState,
    views: Sequence[View],
    *,
    render: RenderFn,
    held_out: Sequence[View] = (),
    on_step: OnStep | None = None,
) -> Fit:
    """Take a run to its end; `on_step` may stop it between two steps by raising."""
    # glibc keeps 64 MiB of what is freed, twice the largest freed block; page faults
    # cost as much as the loss.
    torch.empty(31 << 20, dtype=torch.uint8)
    config = state.config
    screen_gradients: ScreenGradients | None = getattr(render, "screen_gradients", None)
    if config.strategy.needs_screen_gradients and screen_gradients is None:
        do = "use Renderer(screen_gradients=ScreenGradients())"
        expected = (
            "a renderer that keeps screen gradients, for"
            f" {type(config.strategy).__name__}"
        )
        raise InvalidValueError.of("render", expected, type(render).__name__, do)
    target_of = targets_of(views, state.parameters["means"].device)
    while state.iteration < config.iterations:
        loss = _step(state, target_of, len(views), render)
        # what is changed last is trained no more
        if state.iteration < config.iterations:
            densify(state, screen_gradients)
        scored = None
        every = config.eval_interval
        if state.iteration == config.iterations or (
            every and state.iteration % every == 0
        ):
            scored = score(state.result(), held_out, render)
        line = Progress(
            iteration=state.iteration,
            loss=loss,
            count=len(state.parameters["means"]),
            held_out=scored,
        )
        if state.iteration == config.iterations or scored is not None:
            state.history.append(line)
        if on_step is not None:
            on_step(line)
    return Fit(
        scene=state.result(),
        history=tuple(state.history),
        config=config,
        seed=state.seed,
    )


def targets_of(views: Sequence[View], device: torch.device) -> Callable[[int], Target]:
    """Camera, image and mask by number, on a device; a GPU keeps as many as fill a
    quarter of its memory.
    """

    def load(index: int) -> Target:
        view = views[index]
        mask = loss_mask_of(views, index)
        return (
            view.camera,
            view.image.to(device),
            None if mask is None else mask.to(device),
        )

    if device.type == "cpu":
        return load
    pixels = max(camera.width * camera.height for camera in cameras_of(views))
    return functools.lru_cache(
        max(1, torch.cuda.mem_get_info()[0] // 4 // (20 * pixels))
    )(load)


def _step(
    state: TrainState, target_of: Callable[[int], Target], count: int, render: RenderFn
) -> float:
    """One image, its loss, its gradient, and a step of Adam."""
    index = state.next_view(count)
    scene = state.scene()
    camera, target, mask = _smaller(
        *target_of(index), state.config.coarseness(state.iteration)
    )
    image = masked(render(scene, camera), mask)
    loss = photometric_loss(
        image, masked(target, mask), lambda_dssim=state.config.lambda_dssim
    )
    state.optimiser.zero_grad()
    value = differentiate(state, loss, scene)
    state.descend()
    state.iteration += 1
    return value


def _smaller(camera: Camera, image: Tensor, mask: Tensor | None, factor: int) -> Target:
    """What to fit, each side divided by a factor; never below the window of SSIM."""
    if factor == 1 or min(camera.width, camera.height) < factor * LEAST_SIDE:
        return camera, image, mask
    return (
        camera.downscaled(factor),
        _area_mean(image, factor),
        None if mask is None else _area_mean(mask[..., None], factor)[..., 0],
    )


def _area_mean(image: Tensor, factor: int) -> Tensor:
    """(H // factor, W // factor, C) means over squares of pixels."""
    means = F.avg_pool2d(image.permute(2, 0, 1)[None], factor)[0]
    return means.permute(1, 2, 0).contiguous()


def differentiate(state: TrainState, loss: Tensor, scene: GaussianScene) -> float:
    """Add the gradient of a loss of a splat, and of what the strategy adds to it, to
    that of the trained tensors.
    """
    loss = state.strategy.before_backward(loss, scene)
    loss.backward()  # type: ignore[no-untyped-call]
    value = float(loss.detach())
    if not math.isfinite(value):
        raise _not_finite(state, value)
    return value


def densify(state: TrainState, screen_gradients: ScreenGradients | None) -> None:
    """Ask the strategy, and do what it says."""
    step = Step(
        parameters=state.parameters,
        iteration=state.iteration,
        iterations=state.config.iterations,
        scene_extent=state.scene_extent,
        lr_means=state.learning_rates()["means"],
        generator=state.generator,
        screen_gradients=screen_gradients,
    )
    edit = state.strategy.after_step(step, state.strategy_state)
    if edit is not None:
        state.apply(edit)


def _not_finite(state: TrainState, value: float) -> TrainingError:
    bad = [
        name
        for name, tensor in state.parameters.items()
        if not bool(torch.isfinite(tensor).all())
    ]
    if bad:
        cause = f"not finite: {', '.join(bad)}"
    else:
        cause = "the parameters are finite, the image or the view is not"
    what = f"loss at step {state.iteration}"
    do = "look at views and rates"
    return TrainingError.of(what, "a finite number", f"{value} ({cause})", do)
