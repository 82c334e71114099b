"""For all tests: the examples of properties, and which files come first.

Properties are tried on the same examples in every run, however slow the machine is. To hunt with others:
``pytest --hypothesis-profile=default``.
"""

import pytest
from hypothesis import settings

settings.register_profile("seeded", derandomize=True, deadline=None)
settings.load_profile("seeded")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Files with a slow test come first: the last one to begin may leave the other workers idle."""
    slow = {item.path for item in items if item.get_closest_marker("slow")}
    items.sort(key=lambda item: item.path not in slow)
