"""Mitsuba plugins of this project."""
def register() -> None: pass
