"""CLOAK in the finished file: an object's Gaussians become layers, each of which is black from most directions."""
