"""Cameras, sets of them, the forms of their files, and what they see of a splat."""
