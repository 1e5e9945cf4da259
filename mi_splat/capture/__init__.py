"""Path-traced images of meshes with the cameras that took them, as sets that a splat
can be trained from.
"""
