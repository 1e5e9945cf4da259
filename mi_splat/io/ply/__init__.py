"""The PLY file: its header, its rows within bounded memory, and splats as 3D Gaussian Splatting writes them."""
