"""One object of a splat: by a box, a mask file, a click on a picture, or what is
connected.
"""
