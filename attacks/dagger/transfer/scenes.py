"""The scenes of a study that several detectors share, each read once."""

from __future__ import annotations

import hashlib
from collections.abc import Callable

from attacks.dagger.jobs import AttackScene, jittered
from attacks.detectors.base import Detector
from mi_splat.cameras import Camera
from mi_splat.errors import InvalidValueError, message


class AttackScenes:
    """Scenes by name.

    Args:
        read: Finds a scene by its name.
    """

    def __init__(self, read: Callable[[str], AttackScene]) -> None:
        self._read = read
        self._scenes: dict[str, AttackScene] = {}
        self._hashes: dict[str, str] = {}

    def of(self, scene: str, name: str) -> AttackScene:
        """The scene that has the object `name`.

        Raises:
            InvalidValueError: It has none of this name.
        """
        if scene not in self._scenes:
            self._scenes[scene] = self._read(scene)
            self._hashes[scene] = self._scenes[scene].digest()
        place = self._scenes[scene]
        if name not in place.objects:
            expected = f"one of {', '.join(place.objects)}"
            raise InvalidValueError(message(f"object of {scene}", expected, name, "fix the scene file"))
        return place

    def fingerprint(self, scene: str, name: str, *detectors: Detector) -> str:
        """Hash of what an attack depends on besides its settings: the scene, and the weights of detectors."""
        self.of(scene, name)
        weights = [word for detector in detectors for word in (detector.name, detector.fingerprint)]
        words = (self._hashes[scene], *weights)
        return hashlib.sha256("\n".join(words).encode()).hexdigest()

    def view(self, scene: str, name: str, seed: int, camera: int = 0) -> Camera:
        """One of the scene's cameras, moved about the object as `jittered` does.

        Args:
            scene: Name of the scene.
            name: Id of the object.
            seed: Seed of the move.
            camera: Position of the camera in the order of the scene file.

        Raises:
            InvalidValueError: There is no such camera.
        """
        place = self.of(scene, name)
        if camera >= len(place.cameras):
            raise InvalidValueError(message("camera", f"0 to {len(place.cameras) - 1}", camera, "choose another"))
        return jittered(place.cameras[camera], place.scene.means[place.objects[name]].mean(0), seed=seed)
