"""The scenes that a study attacks."""

from __future__ import annotations

from pathlib import Path

from attacks.dagger.jobs import AttackScene
from mi_splat.rendering import Renderer
from mi_splat.scene_files import read_scene


def read_attack_scene(path: Path) -> AttackScene:
    """A scene XML ready for attacks."""
    loaded = read_scene(path)
    return AttackScene(
        scene=loaded.scene,
        objects=loaded.objects,
        cameras=tuple(loaded.cameras.values()),
        render=Renderer(loaded.settings),
    )
