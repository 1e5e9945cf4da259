"""Cameras of CARLA rendered from splats: a renderer for the service of carla-canvas (`pip install carla-canvas`).

    PYTHONPATH=docs/examples carla-canvas serve --config docs/examples/canvas.yaml

carla-canvas takes the measurements of a CARLA client's sensors from a service (gRPC) in place of the CARLA server. It
asks a renderer for a picture and its depths at a pose; of the depths it makes LiDARs, too. CARLA's vehicles are splats
that stand where the simulation has them. Its frame has y to the right; carla-canvas gives poses with y to the left.
"""

import math

import numpy as np
import torch
from carla_canvas import ActorInfo, CameraFrame, CameraView, Renderer, WorldInfo

from mi_splat.cameras import Camera
from mi_splat.errors import InvalidValueError, message
from mi_splat.rendering import Renderer as SplatRender
from mi_splat.scene import GaussianScene, Similarity, merge
from mi_splat.scene_files import open_scene


class SplatRenderer(Renderer):  # type: ignore[misc]  # carla-canvas has no types
    """A map and actors that are splats in metres, z up; an actor's splat faces +x and stands on z = 0."""

    name = "mi-splat"
    version = "1"
    camera_outputs = frozenset({"rgb", "depth"})
    coordinate_frame = "right_handed"

    def load_world(self, world: WorldInfo) -> None:
        """Load the splats that `renderer.assets` of the configuration names for a map.

        Raises:
            InvalidValueError: No pattern of `maps` fits the map.
            MiSplatError: A file cannot be read.
        """
        assets = world.config.get("assets") or {}
        maps = dict(assets.get("maps") or {})
        actor = ActorInfo(id=0, type_id=world.map_basename)
        fitting = [file for pattern, file in maps.items() if actor.matches(pattern)]
        if not fitting:
            raise InvalidValueError(
                message("renderer.assets.maps", f"a pattern that fits {actor.type_id}", list(maps), "add one")
            )
        loaded = open_scene(world.resolve(fitting[0]))
        self.map, self.settings = loaded.scene, loaded.settings
        files = dict(assets.get("actors") or {})
        self.actors = {pattern: open_scene(world.resolve(file)).scene for pattern, file in files.items()}

    def render_camera(self, view: CameraView) -> CameraFrame:
        """A picture (sRGB) and the median depths along the optical axis (metres, infinite where nothing is)."""
        camera = Camera(
            to_world=torch.from_numpy(np.linalg.inv(view.world_to_camera_cv())),
            focal=view.camera.width / 2 / math.tan(math.radians(view.camera.fov) / 2),
            width=view.camera.width,
            height=view.camera.height,
        )
        with torch.no_grad():
            seen = SplatRender(self.settings).outputs(self._placed(view), camera)
        depth = torch.where(seen.alpha < 0.5, torch.inf, seen.median_depth)
        pixels = (seen.image.clamp(0, 1) * 255).round().to(torch.uint8)
        return CameraFrame(rgb=pixels.numpy(), depth=depth.numpy())

    def _placed(self, view: CameraView) -> GaussianScene:
        """The map with those actors of a frame that have splats."""
        parts = [self.map]
        for number in view.scene.states:
            actor = view.scene.actors.get(number)
            if actor is None or not actor.is_visible_body or number in view.ignore_actors:
                continue
            fitting = [splat for pattern, splat in self.actors.items() if actor.matches(pattern)]
            if fitting:
                pose = torch.from_numpy(view.actor_matrix(number)).to(torch.float32)
                parts.append(fitting[0].transform(Similarity(rotation=pose[:3, :3], translation=pose[:3, 3])))
        return merge(*parts)
