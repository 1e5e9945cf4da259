"""Renderers beside each other: how far apart their images and their gradients are,
and what they cost.
"""
