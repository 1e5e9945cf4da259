"""One object of a splat: by a box, a mask file, a click on an image, or what is
connected.
"""
