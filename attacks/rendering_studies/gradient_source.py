"""A renderer that shows the pictures of one renderer and has the gradient of another."""

from __future__ import annotations

from torch import Tensor, no_grad

from mi_splat.cameras import Camera, RenderFn
from mi_splat.scene import GaussianScene


def with_gradient_of(gradient: RenderFn, picture: RenderFn) -> RenderFn:
    """The pictures of `picture`, through which autograd goes as through those of `gradient`.

    A derivative of the loss by the pixels is therefore that at the picture that is shown; the derivative of the pixels
    by the Gaussians is the other renderer's.

    Args:
        gradient: A differentiable renderer.
        picture: Any renderer.
    """

    def rendered(scene: GaussianScene, camera: Camera) -> Tensor:
        with no_grad():
            shown = picture(scene.detach(), camera)
        if not any(tensor.requires_grad for tensor in scene.tensors()):
            return shown
        carrier = gradient(scene, camera)
        return carrier + (shown - carrier).detach()

    return rendered
