"""DAGGER for cameras that move: expectation over transformation (Athalye et al. 2018)."""
