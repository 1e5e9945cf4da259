"""Poison-splat: training images that make a splat cost more ("Poison-splat", Lu et
al. 2024, arXiv 2410.08190).

A trainer adds Gaussians where images vary. So the attacker raises the total variation
of the images, within a ball around the clean ones, and in such a way that all cameras
agree: a decoy, a splat that starts as the victim's own, learns the images of raised
variation, and its renders, clipped to the ball, are what the victim gets.

The controls do without the decoy: noise, and images of which each is raised by
itself.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import torch
from torch import Generator, Tensor

from attacks.poisons.base import (
    OnStep,
    Poisoned,
    ball,
    chosen_views,
    poisoned,
    sign_steps,
    within_ball,
)
from attacks.poisons.config import (
    FilterConfig,
    PoisonSplatConfig,
    RaisedVariationConfig,
    UniformNoiseConfig,
    Variation,
)
from attacks.poisons.defences import filtered
from mi_splat.cameras.camera import Camera, View, cameras_of, project_points
from mi_splat.errors import InvalidValueError
from mi_splat.render import variant
from mi_splat.render.renderer import Renderer, RenderSettings, ScreenGradients
from mi_splat.scene import GaussianScene, check_scene, scene_hash
from mi_splat.training.config import FitConfig
from mi_splat.training.loop import densify, differentiate, scene_extent
from mi_splat.training.losses import photometric_loss
from mi_splat.training.state import TrainState, check_start
from mi_splat.training.strategies import ClassicConfig, FixedConfig, StrategyConfig

# A decoy: a splat that learns changed images, so that its own images are changed
# alike from every camera.
#
# Poison-splat begins with it (Lu et al. 2024, arXiv 2410.08190): what an image alone
# would gain, no other camera would confirm, and a splat that is trained on such
# images averages it away.

Target = Callable[[Tensor, int], Tensor]
"""The image that a decoy learns next, from its own one, (H, W, 3) sRGB, and the
position of the view.
"""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Decoy:
    """Where a decoy begins, and how it is rendered and trained."""

    start: GaussianScene
    near: float  # near plane of the victim's renderer, world units
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)  # sRGB behind the splat
    victim: FitConfig = field(default_factory=FitConfig)

    def learn(
        self,
        views: Sequence[View],
        target: Target,
        *,
        steps: int,
        every: int = 1,
        strategy: StrategyConfig | None = None,
        look: Callable[[Tensor], Tensor] | None = None,
        seed: int = 0,
        on_step: OnStep | None = None,
    ) -> GaussianScene:
        """The decoy after some steps, each towards the target at one camera; cameras
        come in shuffled epochs.
        """
        state = self._begun(views, steps, strategy or FixedConfig(), seed)
        if strategy is not None:  # as the victim's rounds do once opacities were reset
            state.strategy_state["opacities_were_reset"][:] = True
        screen_gradients = ScreenGradients() if strategy is not None else None
        render = self._renderer(screen_gradients)
        look = look or (lambda image: image)
        while state.iteration < steps:
            index = state.next_view(len(views))
            scene = state.scene()
            image = render(scene, views[index].camera)
            wanted = look(target(image, index))
            differentiate(
                state,
                photometric_loss(
                    look(image), wanted, lambda_dssim=state.config.lambda_dssim
                ),
                scene,
            )
            state.iteration += 1
            if state.iteration % every == 0:
                state.descend()
                state.optimiser.zero_grad()
            if state.iteration < steps:
                densify(state, screen_gradients)
            if on_step is not None:
                on_step(state.iteration, steps)
        return state.result()

    def picture(self, decoy: GaussianScene, camera: Camera) -> Tensor:
        """(H, W, 3) sRGB, what a camera sees of a decoy."""
        with torch.no_grad():
            return self._renderer()(decoy, camera)

    def _begun(
        self, views: Sequence[View], steps: int, strategy: StrategyConfig, seed: int
    ) -> TrainState:
        check_scene("start", self.start)
        fit = replace(
            self.victim,
            iterations=steps,
            strategy=strategy,
            sh_degree=self.start.degree,
            sh_degree_interval=0,
            # the public implementation lowers none
            lr_means_final=self.victim.lr_means,
            lr_sh_final=None,
            lr_sh_divisor=20,
        )
        check_start(self.start, fit)
        if not any(
            _is_seen(self.start, camera, self.near) for camera in cameras_of(views)
        ):
            expected = "Gaussians before some camera of the views"
            do = "pass a splat that was trained on these views"
            raise InvalidValueError.of("start", expected, "none", do)
        return TrainState(self.start, fit, scene_extent=scene_extent(views), seed=seed)

    def _renderer(self, screen_gradients: ScreenGradients | None = None) -> Renderer:
        name = "cuda_ad_rgb" if self.start.means.is_cuda else variant.DEFAULT_VARIANT
        settings = RenderSettings(
            background=self.background, near=self.near, variant=name
        )
        return Renderer(settings, screen_gradients=screen_gradients)


def _is_seen(scene: GaussianScene, camera: Camera, near: float) -> bool:
    pixels, depths = project_points(scene.means.detach().cpu(), camera)
    inside = (
        (pixels >= 0) & (pixels <= pixels.new_tensor([camera.width, camera.height]))
    ).all(1)
    return bool((inside & (depths > near)).any())


def total_variation(image: Tensor, variation: Variation = "both") -> Tensor:
    """Sum of the absolute differences between neighbours of an image (H, W, 3),
    differentiable.
    """
    along_columns = (image[1:] - image[:-1]).abs().sum()
    if variation == "vertical":
        return 2 * along_columns
    return along_columns + (image[:, 1:] - image[:, :-1]).abs().sum()


def raised(
    image: Tensor, clean: Tensor, config: PoisonSplatConfig | RaisedVariationConfig
) -> Tensor:
    """An image of more total variation, reached by steps along the sign of its
    gradient.
    """
    look = _through(config.through)
    return sign_steps(
        image.detach().clamp(0, 1),
        ball(clean, config.eps),
        lambda picture: total_variation(look(picture), config.variation),
        steps=config.variation_steps,
        step=2 / 255,  # the paper's
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PoisonSplat:
    """Poison-splat as a poison."""

    config: PoisonSplatConfig
    begun: Decoy

    def __call__(
        self, views: Sequence[View], *, seed: int = 0, on_step: OnStep | None = None
    ) -> Poisoned:
        """The poisoned set; with eps or a share of 0 it is the untouched one, image
        for image.
        """
        config = self.config
        begun = self.begun
        chosen = chosen_views(views, config.share, seed)
        about = _about("poison-splat", config, seed)
        if config.eps == 0 or not chosen:
            return poisoned(views, {}, about)
        decoy = self.decoy(views, seed=seed, on_step=on_step)
        about |= {
            "start": scene_hash(begun.start),
            "start_gaussians": len(begun.start),
            "decoy_gaussians": len(decoy),
        }
        pictures = {}
        for index in chosen:
            view = views[index]
            pictures[index] = within_ball(
                begun.picture(decoy, view.camera), view.image, config.eps
            )
        return poisoned(views, pictures, about)

    def decoy(
        self, views: Sequence[View], *, seed: int = 0, on_step: OnStep | None = None
    ) -> GaussianScene:
        """The splat whose images the victim gets; arguments and errors are those of a
        call.
        """
        config = self.config
        return self.begun.learn(
            views,
            lambda image, index: raised(
                image, views[index].image.to(image.device), config
            ),
            steps=config.steps,
            every=config.decoy_every,
            strategy=self._strategy(),
            look=_through(config.through),
            seed=seed,
            on_step=on_step,
        )

    def _strategy(self) -> StrategyConfig | None:
        config = self.config
        victims = self.begun.victim.strategy
        if not config.densify_every:
            return None
        return replace(
            victims if isinstance(victims, ClassicConfig) else ClassicConfig(),
            densify_from=0,
            densify_until=config.steps,
            densify_interval=config.densify_every,
            opacity_reset_interval=0,
            max_gaussians=config.max_gaussians,
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class UniformNoise:
    """A control: whole steps of 1/255 that are drawn evenly from the ball, channel by
    channel.
    """

    config: UniformNoiseConfig = field(default_factory=UniformNoiseConfig)

    def __call__(
        self, views: Sequence[View], *, seed: int = 0, on_step: OnStep | None = None
    ) -> Poisoned:
        """The set with noise; each image's is its own, whatever share is changed."""
        eps = self.config.eps

        def noisy(view: View, index: int) -> Tensor:
            generator = Generator().manual_seed(seed * 1_000_003 + index)
            noise = (
                torch.randint(-eps, eps + 1, view.image.shape, generator=generator)
                / 255
            )
            return within_ball(view.image + noise.to(view.image), view.image, eps)

        return _one_by_one("uniform-noise", views, self.config, noisy, seed, on_step)


@dataclass(frozen=True, slots=True, kw_only=True)
class RaisedVariation:
    """A control: total variation raised image by image, so that cameras do not
    agree.
    """

    config: RaisedVariationConfig = field(default_factory=RaisedVariationConfig)

    def __call__(
        self, views: Sequence[View], *, seed: int = 0, on_step: OnStep | None = None
    ) -> Poisoned:
        """The set of raised variation."""
        config = self.config

        def changed(view: View, index: int) -> Tensor:
            return within_ball(
                raised(view.image, view.image, config), view.image, config.eps
            )

        return _one_by_one("raised-variation", views, config, changed, seed, on_step)


def _one_by_one(
    kind: str,
    views: Sequence[View],
    config: UniformNoiseConfig | RaisedVariationConfig,
    change: Callable[[View, int], Tensor],
    seed: int,
    on_step: OnStep | None,
) -> Poisoned:
    """A set of which each chosen image is changed by itself."""
    chosen = chosen_views(views, config.share, seed) if config.eps else []
    pictures = {}
    for number, index in enumerate(chosen, start=1):
        pictures[index] = change(views[index], index)
        if on_step is not None:
            on_step(number, len(chosen))
    return poisoned(views, pictures, _about(kind, config, seed))


def _about(
    kind: str,
    config: PoisonSplatConfig | UniformNoiseConfig | RaisedVariationConfig,
    seed: int,
) -> dict[str, Any]:
    return {"kind": kind, **asdict(config), "seed": seed}


def _through(config: FilterConfig | None) -> Callable[[Tensor], Tensor]:
    if config is None:
        return lambda image: image
    return lambda image: filtered(image, config)
