"""CLOAK: poisoned training pictures, so that a splat looks different from chosen
directions.
"""
