"""Fixtures of the tests of studies."""

from __future__ import annotations

from tests.studies.toy import toys

__all__ = ["toys"]
