"""Classifiers: which class a picture shows, differentiable in the picture."""
