"""Renderers beside each other: how far apart their pictures and their gradients are,
and what they cost.
"""
