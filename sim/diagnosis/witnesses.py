"""The second witness of each cause: direct tests of its signature in the readings, which use no fit of the stage."""

from __future__ import annotations

from dehyst.sim.diagnosis.catalogue import CATALOGUE, Catalogue
from dehyst.sim.fitting.parallel import side_by_side
from dehyst.sim.readings.readings import Readings
from dehyst.sim.readings.sight import Sight


def witnesses(readings: Readings, catalogue: Catalogue = CATALOGUE) -> dict[str, Sight]:
    """What the direct tests say, by cause. Of several tests of one cause, what one sees counts before what it does
    not."""
    # The shared parts are computed once, before the tests run on two threads.
    _ = readings.rests, readings.cycles, readings.left_um, readings.response
    tests = [(name, test) for name, cause in catalogue.causes.items() for test in cause.tests]
    sights = side_by_side(lambda one: one[1](readings), tests)
    out: dict[str, Sight] = {}
    for (name, _), sight in zip(tests, sights, strict=True):
        if name not in out or _weight(sight) > _weight(out[name]):
            out[name] = sight
    return out


def _weight(sight: Sight) -> int:
    return {True: 2, False: 1, None: 0}[sight.seen]
