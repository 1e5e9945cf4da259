"""The shape `gaussians`: any splat that this library reads, as Mitsuba's `ellipsoids`.

===========  ================  =========================================================
parameter    type              meaning
===========  ================  =========================================================
filename     string            a splat file, looked up beside the scene file and on
                               Mitsuba's search path
means        tensor (N, 3)     instead of a file, from Python: the five tensors of a
                               GaussianScene
scales       tensor (N, 3)     standard deviations, world units
rotations    tensor (N, 4)     quaternions w, x, y, z
opacities    tensor (N, )      in [0, 1]
sh           tensor (N, K, 3)  spherical harmonics in 3DGS order
to_world     transform         rotation, translation and uniform scale; the spherical
                               harmonics turn with it
extent, ...  as `ellipsoids`   passed on to Mitsuba's shape
===========  ================  =========================================================

`mi.traverse` shows `<id>.data` (N x 10: centre, standard deviations, quaternion x, y,
z, w), `<id>.opacities` (N) and `<id>.sh_coeffs` (N x 3K), all differentiable.
"""

from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import torch

from mi_splat.attributes import ATTRIBUTES
from mi_splat.errors import InvalidValueError
from mi_splat.io import load_splat
from mi_splat.render.plugins.gaussian_shapes import watch_rendering
from mi_splat.render.tile.frozen import aligned
from mi_splat.scene import GaussianScene, Similarity

_PASSED_ON = ("extent", "extent_adaptive_clamping")


def gaussians(props: Any) -> Any:
    """Factory that Mitsuba calls for `<shape type="gaussians">`."""
    watch_rendering()
    given = [name for name in ATTRIBUTES if name in props]
    if "filename" in props and not given:
        scene = load_splat(Path(str(mi.file_resolver().resolve(props["filename"]))))
    elif len(given) == len(ATTRIBUTES):
        scene = GaussianScene(
            *(
                torch.from_numpy(np.array(props[name], dtype=np.float32))
                for name in ATTRIBUTES
            )
        )
    else:
        expected = f"a filename, or the tensors {', '.join(ATTRIBUTES)}"
        got = ", ".join(props.keys()) or "neither"
        raise InvalidValueError.of(
            f'shape "{props.id()}"', expected, got, "give one or the other"
        )
    if "to_world" in props:
        matrix = torch.from_numpy(np.array(props["to_world"].matrix))
        scene = scene.transform(Similarity.from_matrix(matrix, "to_world"))
    extra = {key: props[key] for key in _PASSED_ON if key in props} | dict(
        props.objects()
    )
    return mi.load_dict(
        {"type": "ellipsoids", "id": props.id(), **ellipsoid_arrays(scene), **extra},
        parallel=False,
    )


def ellipsoid_arrays(scene: GaussianScene) -> dict[str, Any]:
    """The entries `data`, `opacities` and `sh_coeffs` of an `ellipsoids` dict for a
    scene.
    """
    means, scales, (w, *xyz) = scene.means, scene.scales, scene.rotations.unbind(1)
    data = torch.cat([means, scales, torch.stack([*xyz, w], dim=1)], dim=1)
    flat = {
        "data": data,
        "opacities": scene.opacities[:, None],
        "sh_coeffs": scene.sh.flatten(1),
    }
    return {key: _tensor(t) for key, t in flat.items()}


def shape_dict(scene: GaussianScene, **extra: Any) -> dict[str, Any]:
    """A dict for `mi.load_dict` that holds `scene` as a `gaussians` shape."""
    arrays: dict[str, Any] = {
        name: _tensor(t) for name, t in zip(ATTRIBUTES, scene.tensors(), strict=True)
    }
    return {"type": "gaussians", **arrays, **extra}


def _tensor(values: torch.Tensor) -> Any:
    # Aligned now, once, and not before each of its images.
    flat = aligned(mi.Float(values.detach().cpu().float().flatten().numpy()))
    return mi.TensorXf(flat, tuple(values.shape))
