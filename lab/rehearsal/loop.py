"""The closed loop in lockstep: the real axis, asked as a client on the wire asks it, and a plant.

Time line, blocks of ``block`` samples::

    block j is asked for when the axis has handled all samples of the blocks up to j - 2; block j - 1 is under way.

So an answer knows of all samples but the last ``block``. Before the first block the stage rests, and the axis sees it
rest for ``IDLE_S``. Nothing depends on a clock: the same seeds give the same run.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from adaptive.types import FloatArray, InverseModel
from lab.rehearsal.disturbance import Line, Message, Sensor, Stand
from lab.rehearsal.reference import Motion
from service.answers.guard import Limits, guard
from service.client.pending import PendingCommands
from service.protocol.query import FeedforwardQuery
from service.server.axis import Axis

#: Called with the samples done.
Ticked = Callable[[int], None]

#: Time for which samples of the stage at rest come before anything is commanded, s.
IDLE_S: Final = 0.2

#: What stands in ``Course.verdict`` for a sample that never came.
NEVER_CAME: Final = "never_came"


@dataclass(frozen=True, slots=True)
class Course:
    """How a run went, sample by sample; arrays are (n,).

    Attributes
    ----------
    t_s : time from the start, s. wanted_um : the reference. true_um : where the stage was. read_um : what was reported
    of it, sent or not. u_V : voltage applied from that instant on. flags : bits of the answer, see
    ``service.protocol.reply``. verdict : index into ``verdicts`` of what was made of the sample. trouble : index into
    ``troubles`` of what the axis called wrong at that time ("" for nothing).
    events : (time s, name, detail) of what the axis noted.
    """

    t_s: FloatArray
    wanted_um: FloatArray
    true_um: FloatArray
    read_um: FloatArray
    u_V: FloatArray
    flags: NDArray[np.uint8]
    verdict: NDArray[np.int16]
    verdicts: tuple[str, ...]
    trouble: NDArray[np.int16]
    troubles: tuple[str, ...]
    events: tuple[tuple[float, str, str], ...]


class _Names:
    """Words as small numbers."""

    def __init__(self, first: str) -> None:
        self._numbers = {first: 0}

    def __call__(self, name: str) -> int:
        return self._numbers.setdefault(name, len(self._numbers))

    @property
    def known(self) -> tuple[str, ...]:
        return tuple(self._numbers)


class _Count:
    """The stage's count as its controller knows it: sample ``tick`` has the number ``tick + offset``.

    It follows the numbers of the samples where most of a message agree on them: one that is wrong does not count.
    """

    def __init__(self, offset: int) -> None:
        self.offset = offset

    def follow(self, message: Message) -> None:
        self.offset = sorted((message.batch.seq - message.tick).tolist())[message.tick.size // 2]


def run_adaptive(
    axis: Axis, stand: Stand, sensor: Sensor, line: Line, wanted: Motion, u_before_V: float, block: int,
    first_number: int, ticked: Ticked = lambda _: None,
) -> Course:  # fmt: skip
    """Close the loop over the (n,) motion ``wanted``, n a multiple of ``block``.

    ``u_before_V``: applied before the first sample, V. ``first_number``: of sample 0, in the stage's count. Raises what
    the plant raises, and what the axis does: nothing that a run asks for is refused by a sound axis.
    """
    n, dt_s = wanted.y_um.size, axis.dt_s
    for first in range(-idle_samples(dt_s, block), 0, block):
        u_rest_V = np.full(block, u_before_V)
        at_rest = line.carry(first, u_rest_V, stand.run(first, u_rest_V)[1])
        if at_rest is not None:
            axis.handle(at_rest.batch)
    true_um, read_um, u_V = np.zeros(n), np.zeros(n), np.zeros(n)
    flags = np.zeros(n, dtype=np.uint8)
    verdict, trouble = np.zeros(n, dtype=np.int16), np.zeros(n, dtype=np.int16)
    verdicts, troubles = _Names(NEVER_CAME), _Names("")
    events: list[tuple[float, str, str]] = []
    commanded, count = PendingCommands(), _Count(first_number)
    before_V, newest = u_before_V, -1  # the last sample of the rest
    for first in range(0, n + block, block):
        part, held = slice(first, first + block), slice(first - block, first)
        if first < n:
            begin = first + count.offset
            # The block before is under way, and the one before that is the newest that can have come.
            axis.age_s = max(0, first - block - 1 - newest) * dt_s
            y_um, v_um_per_s, a_um_per_s2 = (values[part] for values in wanted)
            query = FeedforwardQuery(
                y_um, v_um_per_s, a_um_per_s2, u_before_V=before_V, pending=commanded.before(begin)
            )
            reply = axis.answer(query)
            u_V[part], flags[part] = reply.u_V, reply.flags
            before_V = float(reply.u_V[-1])
            commanded.take(begin, y_um, reply)
            true_um[part], now_um = stand.run(first, u_V[part])
            read_um[part] = sensor.read(first, now_um)
        if first == 0:
            continue
        # The samples of the block before come while this block is asked for.
        message = line.carry(held.start, u_V[held], read_um[held])
        if message is not None:
            for tick, said in zip(message.tick.tolist(), axis.handle(message.batch), strict=True):
                verdict[tick] = verdicts(said)
            newest = held.stop - 1
            count.follow(message)
        # Known from the end of the block on, and until then what was known before.
        trouble[held] = trouble[held.start - 1] if held.start else 0
        trouble[held.stop - 1] = troubles(axis.newest.trouble)
        events += [((held.stop - 1) * dt_s, *_told(event)) for event in axis.take_events()]
        ticked(held.stop)
    return Course(
        times(n, dt_s), wanted.y_um, true_um, read_um, u_V, flags, verdict, verdicts.known, trouble,
        troubles.known, tuple(events),
    )  # fmt: skip


def run_frozen(
    model: InverseModel, stand: Stand, wanted: Motion, u_before_V: float, limits: Limits, block: int
) -> Course:
    """The same without learning: the identified model alone, its memory carried along what is wanted, not readings."""
    n = wanted.y_um.size
    idle = idle_samples(model.dt_s, block)
    stand.run(-idle, np.full(idle, u_before_V))
    answer = model.feedforward(*wanted, model.rest_memory(float(wanted.y_um[0])))
    u_V, flags = guard(answer.u_V, answer.inside, model.dt_s, limits, u_before_V)
    true_um, read_um = stand.run(0, u_V)
    none = np.zeros(n, dtype=np.int16)
    return Course(
        times(n, model.dt_s), wanted.y_um, true_um, read_um, u_V, flags, none, ("not_learning",), none, ("",), ()
    )


def times(n: int, dt_s: float) -> FloatArray:
    """(n,) times, s, ``dt_s`` apart."""
    t_s: FloatArray = np.arange(n, dtype=np.float64) * dt_s
    return t_s


def idle_samples(dt_s: float, block: int) -> int:
    """Samples of the rest before the first block: whole blocks, at least two."""
    return max(2, math.ceil(IDLE_S / dt_s / block)) * block


def _told(event: dict[str, Any]) -> tuple[str, str]:
    return str(event["event"]), str(event["detail"])
