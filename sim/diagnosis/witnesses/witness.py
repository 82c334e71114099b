"""The verdict of one direct test, and the list of all of them."""

from __future__ import annotations

from collections.abc import Callable

from sim.diagnosis.parallel import side_by_side
from sim.diagnosis.witnesses import drive, loop, other, response, slow
from sim.diagnosis.witnesses.readings import Readings, Sight

#: A direct test: from the readings to what it says of one or several causes.
Test = Callable[[Readings], list[Sight]]

TESTS: tuple[Test, ...] = (
    slow.creep_and_drifts,
    slow.cycles_over_time,
    response.resonance,
    response.lags_and_delay,
    drive.slew_limit,
    drive.saturation,
    loop.even_part,
    loop.rate_dependence,
    loop.widths,
    other.cross_talk,
    other.mains_hum,
    other.timing,
)


def witnesses(readings: Readings) -> dict[str, Sight]:
    """What the direct tests say, by cause. Where two tests speak of one cause, the one that saw it counts."""
    out: dict[str, Sight] = {}
    # The shared parts are computed once, before the tests run on two threads.
    _ = readings.rests, readings.cycles, readings.left_um, readings.response
    for sights in side_by_side(lambda test: test(readings), TESTS):
        for sight in sights:
            old = out.get(sight.name)
            if old is None or _weight(sight) > _weight(old):
                out[sight.name] = sight
    return out


def _weight(sight: Sight) -> int:
    return {True: 2, False: 1, None: 0}[sight.seen]


__all__ = ["Sight", "Test", "witnesses"]
