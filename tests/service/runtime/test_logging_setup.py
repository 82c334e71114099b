"""Messages of a process: one handler, levels, and the journal's priorities."""

from __future__ import annotations

import io
import logging
from collections.abc import Iterator
from pathlib import Path

import pytest

from dehyst.service.runtime.logging_setup import set_up_logging

log = logging.getLogger("dehyst.test")


@pytest.fixture(autouse=True)
def _as_before() -> Iterator[None]:
    root, ours = logging.getLogger(), logging.getLogger("dehyst")
    levels, handlers = (root.level, ours.level), list(root.handlers)
    yield
    root.handlers[:] = handlers
    root.setLevel(levels[0])
    ours.setLevel(levels[1])


def test_warnings_come_by_default_and_information_on_request() -> None:
    stream = io.StringIO()
    set_up_logging(stream=stream)
    log.info("a detail")
    log.warning("a trouble")
    assert "a detail" not in stream.getvalue()
    assert stream.getvalue().endswith("WARNING dehyst.test: a trouble\n")
    set_up_logging("info", stream)
    log.info("a detail")
    # A second call replaces the handler: the line comes once.
    assert stream.getvalue().count("a detail") == 1


def test_the_journal_gets_priorities_and_no_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with (tmp_path / "stderr").open("w+", encoding="utf-8") as stream:
        status = (tmp_path / "stderr").stat()
        monkeypatch.setenv("JOURNAL_STREAM", f"{status.st_dev}:{status.st_ino}")
        set_up_logging("debug", stream)
        log.debug("d")
        log.info("i")
        log.warning("w\nsecond line")
        log.error("e")
        stream.seek(0)
        assert stream.read().splitlines() == [
            "<7>dehyst.test: d", "<6>dehyst.test: i", "<4>dehyst.test: w", "<4>second line", "<3>dehyst.test: e",
        ]  # fmt: skip
