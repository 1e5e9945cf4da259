"""Spherical harmonics, rotations, colour curves, neighbours and image metrics."""
