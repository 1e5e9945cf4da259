"""Renderers of splats: rasteriser, ray tracer, Mitsuba plugins, scene files."""
