"""Cameras in the JSON files that the commands write, so that a later command can look from the same places.

Also in the cameras.json that the trainer of 3D Gaussian Splatting (Kerbl et al. 2023) writes beside its splats: a list
of objects with img_name, width, height, fx, fy, position (3,) and rotation (3, 3), camera to world with our axes.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import torch

from mi_splat.cameras import Camera
from mi_splat.errors import InvalidValueError, message


def describe(name: str, camera: Camera) -> dict[str, object]:
    """A camera as JSON can hold it; the pose has x right, y down, z forward."""
    return {"name": name, **values_of(camera)}


def values_of(camera: Camera) -> dict[str, object]:
    """All of a camera but a name, as JSON can hold it; `camera_of` makes the same camera of it again."""
    return {
        "to_world": camera.to_world.tolist(),
        "focal": [camera.fx, camera.fy],
        "principal": [camera.cx, camera.cy],
        "size": [camera.width, camera.height],
    }


def recorded_cameras(path: Path, *, reference: bool = True) -> dict[str, Camera] | None:
    """The cameras, by name, of a file that one of the commands or the trainer of 3DGS has written.

    Of an attack on a distribution of views it is the reference camera alone, with which the attack can be repeated.

    Args:
        path: cameras.json, result.json, evaluation.json or sanity.json.
        reference: Whether such a reference camera counts, from which the object need not have been looked at.

    Returns:
        None if it is no such file; it may be one of another program.

    Raises:
        InvalidValueError: It is such a file, but a camera in it is broken.
    """
    try:
        document = json.loads(path.read_text("utf-8"))
    except (OSError, ValueError):
        return None
    entries = _entries(document)
    if not entries or (not reference and "reference" in document):
        return None
    try:
        return {
            str(entry.get("name", entry.get("img_name", number))): camera_of(entry)
            for number, entry in enumerate(entries)
        }
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        do = "write it again"
        raise InvalidValueError(message(str(path), "cameras as the commands write them", error, do)) from error


def _entries(document: Any) -> list[Any]:
    """What describes the cameras in a document; nothing in one of another program."""
    if isinstance(document, list):
        return document
    if not isinstance(document, dict) or "frames" in document:
        return []
    if "reference" in document:  # of an attack on a distribution of views, which are drawn about this camera
        return [document["reference"]]
    if isinstance(document.get("views"), list):  # of an attack, whose cameras are called by names beside the views
        names = document.get("cameras") or range(len(document["views"]))
        pairs = zip(names, document["views"], strict=False)
        return [{"name": name, **view["camera"]} for name, view in pairs if isinstance(view, dict) and "camera" in view]
    found = document.get("cameras")
    return found if isinstance(found, list) else []


def camera_of(entry: dict[str, Any]) -> Camera:
    """A camera as `describe`, or the trainer of 3DGS, writes it.

    Raises:
        KeyError, TypeError, ValueError: It lacks something, or something is no number.
    """
    if "rotation" in entry:  # of the trainer of 3DGS
        pose = torch.eye(4, dtype=torch.float64)
        pose[:3, :3] = torch.tensor(entry["rotation"], dtype=torch.float64)
        pose[:3, 3] = torch.tensor(entry["position"], dtype=torch.float64)
        focal = (entry["fx"], entry["fy"])
        return Camera(to_world=pose, focal=focal, width=entry["width"], height=entry["height"])
    width, height = entry["size"]
    fx, fy = entry["focal"]
    cx, cy = entry["principal"]
    return Camera(
        to_world=torch.tensor(entry["to_world"], dtype=torch.float64),
        focal=(fx, fy),
        width=width,
        height=height,
        principal=(cx, cy),
    )
