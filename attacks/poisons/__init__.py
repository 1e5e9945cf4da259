"""Attacks on training images, of which CLOAK is one."""
