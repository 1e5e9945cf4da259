"""Lint of a splat file: numbers that break it, hide something in it, or make it expensive to draw."""
