"""CLOAK: poisoned training images, so that a splat looks different from chosen
directions.
"""
