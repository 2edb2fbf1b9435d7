"""Shared by the tests of the client: the service in memory."""

from tests.service.conftest import configure, serving

__all__ = ["configure", "serving"]
