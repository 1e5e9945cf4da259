"""Splats on a page in the browser, in pictures that the project's own renderer
makes.
"""
