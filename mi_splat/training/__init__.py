"""Training of splats from views: the recipe of 3D Gaussian Splatting, on any
differentiable renderer.
"""
