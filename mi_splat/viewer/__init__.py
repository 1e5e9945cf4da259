"""Splats on a page in the browser, in images that the project's own renderer
makes.
"""
