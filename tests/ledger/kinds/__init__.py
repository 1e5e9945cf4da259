"""Kinds of jobs that tests run: small, and without torch."""
