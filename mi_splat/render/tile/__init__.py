"""A deterministic, differentiable tile rasteriser for 3D Gaussians in Dr.Jit; knows
arrays and a camera, no scene.
"""
