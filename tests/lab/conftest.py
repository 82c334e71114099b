"""Fixtures that tests of the laboratory share with those of the service."""

from tests.service.conftest import free_port

__all__ = ["free_port"]
