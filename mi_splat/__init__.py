"""3D Gaussian splats in Mitsuba: scenes, files, rendering, capture."""
