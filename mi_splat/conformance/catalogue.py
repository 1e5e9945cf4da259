"""Everything that has a name: scenes, deviations, profiles."""

from __future__ import annotations

from typing import Any

from mi_splat.conformance.capabilities import CAPABILITIES
from mi_splat.conformance.deviations import DEVIATIONS, PROFILES
from mi_splat.conformance.scenes import SIZES, conformance_scenes


def catalogue() -> dict[str, Any]:
    """Scenes with their facts, deviations, capabilities, and the deviations of each
    profile.
    """
    return {
        "scenes": {scene.name: scene.fact for scene in conformance_scenes(SIZES[0])},
        "deviations": {key: found.text for key, found in DEVIATIONS.items()},
        "capabilities": {key: found.text for key, found in CAPABILITIES.items()},
        "profiles": {name: list(keys) for name, keys in PROFILES.items()},
    }


def catalogue_lines() -> list[str]:
    """The same for a terminal."""
    named = catalogue()
    lines = [f"{name:18}{fact}" for name, fact in named["scenes"].items()]
    lines += ["", "Deviations, for --accept:"]
    lines += [f"{key:34}{text}" for key, text in named["deviations"].items()]
    lines += ["", "What a renderer may lack, for --cannot:"]
    lines += [f"{key:18}{text}" for key, text in named["capabilities"].items()]
    lines += ["", "Profiles, for --profile:"]
    lines += [f"{name:18}{', '.join(keys)}" for name, keys in named["profiles"].items()]
    return lines
