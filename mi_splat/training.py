"""Training of splats from views: the recipe of 3D Gaussian Splatting (Kerbl et al. 2023), whatever renders.

A run is a value (`Run`) that is advanced a step at a time, so that it can be saved and taken up again to the bit. The
order of the views, the children of splits and the noise of MCMC all come from one seeded generator.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Literal

import torch
import torch.nn.functional as F  # noqa: N812
from torch import Generator, Tensor

from mi_splat import densify
from mi_splat.cameras import RenderFn, View
from mi_splat.densify import ClassicConfig, Edit, MCMCConfig
from mi_splat.errors import InvalidValueError, MiSplatError, message
from mi_splat.io.file_space import from_file_space, to_file_space
from mi_splat.metrics import psnr
from mi_splat.photometric import photometric
from mi_splat.scene import GaussianScene

Attribute = Literal["means", "scales", "rotations", "opacities", "sh"]
TRAINABLE: tuple[Attribute, ...] = ("means", "scales", "rotations", "opacities", "sh")


class TrainingError(MiSplatError):
    """Training that cannot go on: values that are not finite, or nothing left to train."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FitConfig:
    """How a splat is trained; the defaults are the published recipe, shortened.

    Attributes:
        iterations: Number of steps; each sees one view.
        trainable: What may change; `("sh",)` trains the texture of a frozen geometry.
        densification: Where Gaussians are added and removed; None keeps their number. Any but None needs means,
            scales, rotations and opacities trainable.
        degree: SH degree of the result.
        degree_every: Steps between two raises of the degree that is trained; 0 trains all of it from the start.
        structure: Weight of D-SSIM in the loss; the rest is L1.
        means: First learning rate of the means, in units of the scene's extent.
        means_last: Last one; between them it decays exponentially.
        scales: Learning rate of the log-scales.
        rotations: Learning rate of the quaternions.
        opacities: Learning rate of the logit opacities.
        sh: Learning rate of the first SH coefficient; the others have a twentieth of it.
        evaluate_every: Steps between two looks at the held-out views; 0 looks at the end only.
    """

    iterations: int = 7000
    trainable: tuple[Attribute, ...] = TRAINABLE
    densification: ClassicConfig | MCMCConfig | None = field(default_factory=ClassicConfig)
    degree: int = 3
    degree_every: int = 1000
    structure: float = 0.2
    means: float = 1.6e-4
    means_last: float = 1.6e-6
    scales: float = 5e-3
    rotations: float = 1e-3
    opacities: float = 5e-2
    sh: float = 2.5e-3
    evaluate_every: int = 1000

    def __post_init__(self) -> None:
        unknown = [name for name in self.trainable if name not in TRAINABLE]
        if unknown or not self.trainable:
            raise InvalidValueError(
                message("trainable", f"some of {', '.join(TRAINABLE)}", self.trainable, "name what may change")
            )
        if self.densification is not None and set(self.trainable) != set(TRAINABLE):
            raise InvalidValueError(
                message("densification", "None where not everything is trained", self.densification, "pass None")
            )
        for name, value, least in (("iterations", self.iterations, 1), ("degree_every", self.degree_every, 0)):
            if value < least:
                raise InvalidValueError(message(name, f"a number >= {least}", value, "ask for more"))
        if self.degree not in (0, 1, 2, 3):
            raise InvalidValueError(message("degree", "0, 1, 2 or 3", self.degree, "3 is what 3DGS writes"))


@dataclass(frozen=True, slots=True, kw_only=True)
class Progress:
    """One step as `on_step` hears of it.

    Attributes:
        iteration: Steps done.
        loss: Loss of this one.
        count: Number of Gaussians after it.
        held_out: PSNR over the held-out views in dB, if they were looked at.
    """

    iteration: int
    loss: float
    count: int
    held_out: float | None = None


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


class Run:
    """Everything that the rest of a training run depends on.

    Attributes:
        parameters: Trained tensors as a splat file holds them, SH in two parts, `dc` (N, 1, 3) and `rest` (N, K - 1, 3).
        iteration: Steps done.
        generator: Source of everything random.
        queue: Numbers of the views still to come in this pass.
        gradient: (N,) sums of the length of the centres' gradients since the last densification.
        visits: (N,) in how many pictures each Gaussian was visible since then.
        was_reset: Whether opacities were ever reset.
    """

    def __init__(self, start: GaussianScene, config: FitConfig, *, extent: float, seed: int) -> None:
        self.config, self.extent, self.seed = config, extent, seed
        values = {k: v.detach().clone() for k, v in to_file_space(start.with_degree(config.degree)).items()}
        sh = values.pop("sh")
        values |= {"dc": sh[:, :1].contiguous(), "rest": sh[:, 1:].contiguous()}
        self.parameters = {name: value.float() for name, value in values.items()}
        self.iteration, self.queue, self.was_reset = 0, list[int](), False
        self.generator = Generator().manual_seed(seed)
        self.gradient, self.visits = torch.zeros(len(start)), torch.zeros(len(start))
        trained = {"dc", "rest"} if "sh" in config.trainable else set[str]()
        trained |= set(config.trainable) & set(self.parameters)
        self.trained = tuple(name for name in self.parameters if name in trained)
        for name in self.trained:
            self.parameters[name].requires_grad_(True)
        groups = [{"params": [self.parameters[name]], "name": name} for name in self.trained]
        self.optimiser = torch.optim.Adam(groups, lr=0.0, eps=1e-15, fused=True)

    @property
    def active(self) -> int:
        """SH degree that is trained now."""
        every = self.config.degree_every
        return self.config.degree if every == 0 else min(self.config.degree, self.iteration // every)

    def scene(self) -> GaussianScene:
        """The splat as it is now, differentiable, with the SH that is trained so far."""
        p = self.parameters
        rest = p["rest"][:, : (self.active + 1) ** 2 - 1]
        return GaussianScene._trusted(
            p["means"],
            p["scales"].exp(),
            F.normalize(p["rotations"], dim=1),
            p["opacities"].sigmoid(),
            torch.cat([p["dc"], rest], dim=1),
        )

    def result(self) -> GaussianScene:
        """The splat as it is now, checked."""
        values = {name: value.detach() for name, value in self.parameters.items()}
        sh = torch.cat([values.pop("dc"), values.pop("rest")], dim=1)
        return from_file_space({**values, "sh": sh})

    def rates(self) -> dict[str, float]:
        """Learning rates at this step."""
        config = self.config
        share = min(self.iteration / config.iterations, 1.0)
        means = math.exp((1 - share) * math.log(config.means) + share * math.log(config.means_last)) * self.extent
        rates = {name: float(getattr(config, name)) for name in ("scales", "rotations", "opacities")}
        return rates | {"means": means, "dc": config.sh, "rest": config.sh / 20}

    def next_view(self, count: int) -> int:
        """Number of the view to look at; all are seen once before any is seen again."""
        if not self.queue:
            self.queue = torch.randperm(count, generator=self.generator).tolist()
        return self.queue.pop()

    def apply(self, edit: Edit) -> None:
        """Exchange the tensors; rows keep their optimiser state unless they are fresh."""
        if not len(edit.source):
            raise TrainingError(
                message("splat", "Gaussians left after pruning", "none", "lower the rates or start from more of them")
            )
        for group in self.optimiser.param_groups:
            name, old = group["name"], group["params"][0]
            new = edit.parameters[name].detach().clone().requires_grad_(True)
            state = self.optimiser.state.pop(old, None)
            if state:
                for key in ("exp_avg", "exp_avg_sq"):
                    moved = state[key][edit.source]
                    moved[edit.fresh] = 0
                    state[key] = moved
                self.optimiser.state[new] = state
            group["params"], self.parameters[name] = [new], new
        self.gradient, self.visits = torch.zeros(len(edit.source)), torch.zeros(len(edit.source))


OnStep = Callable[[Progress], None]


def extent_of(views: Sequence[View]) -> float:
    """Size of what the cameras look at: 1.1 times the largest distance of one from their mean, world units."""
    positions = torch.stack([view.camera.position for view in views])
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
        views: Pictures to match.
        start: Gaussians to begin with.
        render: Any differentiable renderer; the classic densification needs the one that fills `watch`, see
            `mi_splat.rendering.Renderer`.
        config: How; the shortened 3DGS recipe if None.
        seed: Seed of everything random.
        held_out: Views to score on that are not trained on.
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
    return advance(run, views, render=render, held_out=held_out, on_step=on_step)


def advance(
    run: Run,
    views: Sequence[View],
    *,
    render: RenderFn,
    held_out: Sequence[View] = (),
    on_step: OnStep | None = None,
) -> Fit:
    """Take a run to its end; `on_step` may stop it between two steps by raising."""
    config, history = run.config, list[Progress]()
    watch = getattr(render, "watch", None)
    if isinstance(config.densification, ClassicConfig) and watch is None:
        raise InvalidValueError(
            message("render", "a renderer that watches centres", type(render).__name__, "use Renderer(watch=Watch())")
        )
    while run.iteration < config.iterations:
        loss = _step(run, views[run.next_view(len(views))], render)
        if watch is not None:
            run.gradient += watch.lengths
            run.visits += watch.visible
        _after(run)
        scored = None
        every = config.evaluate_every
        if run.iteration == config.iterations or (every and run.iteration % every == 0):
            scored = _score(run, held_out, render)
        line = Progress(iteration=run.iteration, loss=loss, count=len(run.gradient), held_out=scored)
        if run.iteration == config.iterations or scored is not None:
            history.append(line)
        if on_step is not None:
            on_step(line)
    return Fit(scene=run.result(), history=tuple(history), config=config, seed=run.seed)


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
    if config is None:
        return
    due = config.start < step <= config.stop and step % config.every == 0
    if isinstance(config, MCMCConfig):
        if due:
            run.apply(densify.relocate(run.parameters, config=config, generator=run.generator))
        with torch.no_grad():
            rate = run.rates()["means"]
            moved = densify.explore(run.parameters, rate=rate, config=config, generator=run.generator)
            run.parameters["means"].copy_(moved)
        return
    if due:
        # Pictures have half their size in normalised device coordinates; `Watch` measures in those.
        mean = run.gradient / run.visits.clamp(min=1)
        edit = densify.classic(
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
        run.parameters["opacities"].copy_(densify.reset_opacities(run.parameters["opacities"]))
    state = run.optimiser.state.get(run.parameters["opacities"])
    if state:
        for key in ("exp_avg", "exp_avg_sq"):
            state[key].zero_()
    run.was_reset = True


def _score(run: Run, views: Sequence[View], render: RenderFn) -> float | None:
    """Mean PSNR over views on clipped pictures."""
    if not len(views):
        return None
    with torch.no_grad():
        scene = run.scene()
        values = [float(psnr(render(scene, view.camera).clamp(0, 1), view.image)) for view in views]
    return sum(values) / len(values)


def _not_finite(run: Run, value: float) -> str:
    bad = [name for name, tensor in run.parameters.items() if not bool(torch.isfinite(tensor).all())]
    cause = f"not finite: {', '.join(bad)}" if bad else "the parameters are finite, the picture or the view is not"
    return message(f"loss at step {run.iteration}", "a finite number", f"{value} ({cause})", "look at views and rates")
