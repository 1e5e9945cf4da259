"""Fixtures of the tests of studies."""

from tests.studies.toy import toys

__all__ = ["toys"]
