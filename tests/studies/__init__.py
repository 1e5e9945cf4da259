"""Tests of attacks.studies."""
