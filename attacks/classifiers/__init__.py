"""Classifiers: which class an image shows, differentiable in the image."""
