"""Loops are compiled wherever they are run from, also where nothing can be written."""

from __future__ import annotations

import logging

import pytest

from dehyst.adaptive import compiled


def test_a_loop_is_compiled_where_no_folder_can_keep_its_machine_code(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """As in a read-only installation of a user without a home; numba itself raises a RuntimeError."""
    numba_caching = pytest.importorskip("numba.core.caching")
    monkeypatch.setattr(numba_caching.CompileResultCacheImpl, "_locator_classes", [])
    compiled._warn_that_nothing_is_kept.cache_clear()

    def twice(x: float) -> float:
        return 2.0 * x

    with caplog.at_level(logging.WARNING, "dehyst"):
        assert compiled.compiled(twice)(4.0) == 8.0
        assert compiled.compiled(twice)(5.0) == 10.0
    (record,) = caplog.records
    assert "set NUMBA_CACHE_DIR" in record.getMessage()
