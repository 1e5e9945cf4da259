"""How the pictures of a study's splats are rendered."""

from attacks.cloak.config import StudyConfig
from mi_splat.rendering import Renderer, RenderSettings, ScreenGradients
from mi_splat.training.config import FitConfig


def settings_of(study: StudyConfig) -> RenderSettings:
    """Background and near plane of every renderer of a study whose near plane is known, as that of a job is."""
    assert study.training.near is not None
    return RenderSettings(background=study.scene.background, near=study.training.near)


def renderer_of(study: StudyConfig, fit: FitConfig | None = None) -> Renderer:
    """What renders the pictures, those of a training if its settings are given."""
    gradients = fit is not None and fit.strategy.needs_screen_gradients
    return Renderer(settings_of(study), screen_gradients=ScreenGradients() if gradients else None)
