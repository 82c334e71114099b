"""Work in the background steps back behind whoever answers: as a process, and as a session where it is its own."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

AUTOGROUP = Path("/proc/self/autogroup")
autogroups = pytest.mark.skipif(
    not AUTOGROUP.exists() or not AUTOGROUP.read_text(), reason="this system does not share by sessions"
)

STEPPED = """
import os, pathlib
from dehyst.service.background.job import step_back
group = pathlib.Path("/proc/self/autogroup")
before = group.read_text() if group.exists() else ""
step_back(7)
print(os.nice(0), before.strip(), group.read_text().strip() if before else "", sep="|")
"""


def stepped(own_session: bool) -> list[str]:
    run = subprocess.run(
        [sys.executable, "-c", STEPPED], capture_output=True, text=True, check=True, start_new_session=own_session
    )
    return run.stdout.strip().split("|")


@pytest.mark.parametrize("own_session", [False, True])
def test_a_process_is_nicer_by_so_many_steps(own_session: bool) -> None:
    assert stepped(own_session)[0] == str(min(os.nice(0) + 7, 19))


@autogroups
def test_a_session_of_its_own_is_as_nice_as_the_process() -> None:
    """Without it the lowest priority takes half a core from those who answer."""
    _, before, after = stepped(own_session=True)
    assert before.endswith("nice 0")
    assert after.endswith("nice 7")


@autogroups
def test_a_session_that_is_anothers_stays_as_it_was() -> None:
    _, before, after = stepped(own_session=False)
    assert after == before
