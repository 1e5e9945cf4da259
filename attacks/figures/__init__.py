"""Figures of results: one tidy frame, and the tables that are made of it."""
