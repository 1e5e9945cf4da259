"""Tests of mi_splat and attacks."""
