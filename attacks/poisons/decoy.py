"""A decoy: a splat that learns changed pictures, so that its own pictures are changed alike from every camera.

Poison-splat begins with it (Lu et al. 2024, arXiv 2410.08190): what a picture alone would gain, no other camera would
confirm, and a splat that is trained on such pictures averages it away.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from attacks.poisons.base import OnStep
from mi_splat import variant
from mi_splat.cameras import Camera, View, cameras_of, project_points
from mi_splat.errors import InvalidValueError
from mi_splat.rendering import Renderer, RenderSettings, ScreenGradients
from mi_splat.scene import GaussianScene, check_scene
from mi_splat.training.config import FitConfig
from mi_splat.training.loop import densify, differentiate, scene_extent
from mi_splat.training.losses import photometric_loss
from mi_splat.training.state import TrainState, check_start
from mi_splat.training.strategies import FixedConfig, StrategyConfig

Target = Callable[[Tensor, int], Tensor]
"""The picture that a decoy learns next, from its own one, (H, W, 3) sRGB, and the position of the view."""


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
        prune_large: bool = False,
        look: Callable[[Tensor], Tensor] | None = None,
        seed: int = 0,
        on_step: OnStep | None = None,
    ) -> GaussianScene:
        """The decoy after some steps, each towards the target at one camera; cameras come in shuffled epochs."""
        state = self._begun(views, steps, strategy or FixedConfig(), seed)
        if strategy is not None and prune_large:
            state.strategy_state["opacities_were_reset"][:] = True
        screen_gradients = ScreenGradients() if strategy is not None else None
        render, look = self._renderer(screen_gradients), look or (lambda image: image)
        while state.iteration < steps:
            index = state.next_view(len(views))
            scene = state.scene()
            image = render(scene, views[index].camera)
            wanted = look(target(image, index))
            differentiate(state, photometric_loss(look(image), wanted, lambda_dssim=state.config.lambda_dssim), scene)
            state.iteration += 1
            if state.iteration % every == 0:
                state.descend()
                state.optimiser.zero_grad(set_to_none=True)
            if state.iteration < steps:
                densify(state, screen_gradients)
            if on_step is not None:
                on_step(state.iteration, steps)
        return state.result()

    def picture(self, decoy: GaussianScene, camera: Camera) -> Tensor:
        """(H, W, 3) sRGB, what a camera sees of a decoy."""
        with torch.no_grad():
            return self._renderer()(decoy, camera)

    def _begun(self, views: Sequence[View], steps: int, strategy: StrategyConfig, seed: int) -> TrainState:
        """The decoy before its first step."""
        check_scene("start", self.start)
        fit = replace(
            self.victim,
            iterations=steps,
            strategy=strategy,
            sh_degree=self.start.degree,
            sh_degree_interval=0,
            lr_means_final=self.victim.lr_means,  # the public implementation lowers none
            lr_sh_final=None,
        )
        check_start(self.start, fit)
        if not any(_is_seen(self.start, camera, self.near) for camera in cameras_of(views)):
            expected, do = "Gaussians before some camera of the views", "pass a splat that was trained on these views"
            raise InvalidValueError.of("start", expected, "none", do)
        return TrainState(self.start, fit, scene_extent=scene_extent(views), seed=seed)

    def _renderer(self, screen_gradients: ScreenGradients | None = None) -> Renderer:
        name = "cuda_ad_rgb" if self.start.means.is_cuda else variant.DEFAULT_VARIANT
        settings = RenderSettings(background=self.background, near=self.near, variant=name)
        return Renderer(settings, screen_gradients=screen_gradients)


def _is_seen(scene: GaussianScene, camera: Camera, near: float) -> bool:
    """Whether a mean lies inside a camera's picture."""
    pixels, depths = project_points(scene.means.detach().cpu(), camera)
    inside = ((pixels >= 0) & (pixels <= pixels.new_tensor([camera.width, camera.height]))).all(1)
    return bool((inside & (depths > near)).any())
