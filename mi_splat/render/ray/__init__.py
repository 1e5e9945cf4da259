"""Gaussians along rays: Dr.Jit arrays and rays in, light, transmittance and gradients
out; knows no scene and no file.

`splats` sorts Gaussians into a tree of boxes, `segments` finds those that a ray meets,
and says what a stretch of a ray sees of them and how much light it lets through, and
carries gradients back. README.md has the model.
"""
