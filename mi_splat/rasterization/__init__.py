"""A deterministic, differentiable tile rasteriser for 3D Gaussians in Dr.Jit; it knows arrays and a camera, no scene."""
