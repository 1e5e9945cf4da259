"""Projected gradient descent on dictionaries of tensors, within a budget; it knows
nothing of splats.
"""
