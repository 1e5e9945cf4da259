"""Random cameras and random changes of images, drawn by seed and number: what an
attack has to survive.
"""
