"""Controllers beside each other on the example's stage."""

from __future__ import annotations

from pathlib import Path

import pytest

from dehyst.adaptive.errors import InputError
from dehyst.lab.rehearsal import RehearsalConfig, factory_of, identify
from dehyst.lab.rehearsal.controllers import HEAD, REPEATING, compare, table
from dehyst.service.cli.python_file import load_object

PLANT = Path(__file__).resolve().parents[3] / "examples" / "plant.py"


@pytest.mark.slow
def test_correction_and_repetition_beside_their_rivals() -> None:
    factory = factory_of(load_object("--plant", f"{PLANT}:Stage", ""))
    known = identify(factory, RehearsalConfig(compete=()))
    with pytest.raises(InputError, match="ages"):
        compare(factory, known, 0.0, 200.0, [0])
    found = compare(factory, known, 0.0, 200.0, [5], seed=2)
    assert [(one.way, one.age) for one in found] == [(way, 5) for way in REPEATING]
    by_way = {one.way: one for one in found}
    alone, rival = by_way["alone"], by_way["iterative"]
    assert by_way["corrected"].moving_pct < 1.1 * alone.moving_pct
    assert by_way["corrected"].first_second_pct < 1.1 * alone.first_second_pct
    assert by_way["I"].moving_pct > 10.0 * alone.moving_pct
    assert by_way["repetition"].lines_pct[-1] < 0.9 * alone.lines_pct[-1]
    assert by_way["repetition"].lines_pct[0] < 0.8 * rival.lines_pct[0]
    told = table(found, markdown=True).splitlines()
    assert told[0].count("|") == len(HEAD) + 1
    assert len(told) == 2 + len(REPEATING)
    assert "an integrator alone" in table(found)
