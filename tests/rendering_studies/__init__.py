"""Tests of attacks.rendering_studies."""
