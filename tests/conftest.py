"""For all tests: the examples of properties, and which files come first.

Properties are tried on the same examples in every run, however slow the machine is. To hunt with others:
``pytest --hypothesis-profile=default``. Services, clients and stages of the tests share a key of their own; xdist's
workers, and the processes that tests start, inherit it.
"""

import atexit
import os
import shutil
import tempfile
from pathlib import Path

import pytest
from hypothesis import settings

settings.register_profile("seeded", derandomize=True, deadline=None)
settings.load_profile("seeded")

if "DEHYST_KEY" not in os.environ:
    _FOLDER = Path(tempfile.mkdtemp(prefix="dehyst-key-"))
    atexit.register(shutil.rmtree, _FOLDER, ignore_errors=True)
    (_FOLDER / "key").write_bytes(os.urandom(16).hex().encode())
    (_FOLDER / "key").chmod(0o600)
    os.environ["DEHYST_KEY"] = str(_FOLDER / "key")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Files with a slow test come first: the last one to begin may leave the other workers idle."""
    slow = {item.path for item in items if item.get_closest_marker("slow")}
    items.sort(key=lambda item: item.path not in slow)
