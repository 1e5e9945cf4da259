"""Random cameras and random changes of pictures, drawn by seed and number: what an
attack has to survive.
"""
