"""Attacks on training pictures, of which CLOAK is one."""
