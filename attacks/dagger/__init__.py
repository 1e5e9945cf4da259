"""DAGGER: projected gradient descent on the Gaussians of one object of a finished splat
file.
"""
