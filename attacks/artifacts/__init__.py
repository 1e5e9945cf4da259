"""Artifacts: a finished result as raw rows, and the figures that follow from them, for whoever wants to check it."""
