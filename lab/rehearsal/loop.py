"""The closed loop in lockstep: the real axis, queried as a client does it, and a plant.

Time line, blocks of ``block`` samples::

    block j is queried when the axis has handled all samples of the blocks up to j - 2; block j - 1 is pending.

So an answer knows all samples but the last ``block``. Before the first block the stage rests for ``IDLE_S``, and the
axis gets these samples. Nothing depends on a clock: the same seeds give the same run.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from adaptive.types import FloatArray, InverseModel
from lab.rehearsal.disturbance import DisturbedPlant, DisturbedSensor, Message, MessageLine
from lab.rehearsal.reference import Motion
from service.answers.guard import Limits, guard
from service.client.client import PendingCommands
from service.protocol.query import FeedforwardQuery
from service.server.axis import Axis

#: Called with the samples done.
LoopProgress = Callable[[int], None]

#: Time for which the stage rests before the first command, s.
IDLE_S: Final = 0.2

#: Verdict of a sample that never arrived.
NEVER_CAME: Final = "never_came"


@dataclass(frozen=True, slots=True)
class LoopRecord:
    """A run sample by sample; arrays are (n,).

    Attributes
    ----------
    t_s : time from the start, s. wanted_um : the reference. true_um : position of the stage. read_um : its reading,
    sent or not. u_V : voltage applied from that instant on. flags : bits of the answer, see
    ``service.protocol.query``. verdict : index into ``verdicts`` of the learner's verdict on the sample. trouble :
    index into ``troubles`` of what the axis reported at that time ("" for nothing).
    jumps : jumps that the learner has believed up to then. events : (time s, name, detail) of the axis' events.
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
    jumps: NDArray[np.int64]
    events: tuple[tuple[float, str, str], ...]


class _NameCodes:
    """Small integers for names."""

    def __init__(self, first: str) -> None:
        self._numbers = {first: 0}

    def __call__(self, name: str) -> int:
        return self._numbers.setdefault(name, len(self._numbers))

    @property
    def known(self) -> tuple[str, ...]:
        return tuple(self._numbers)


class _NumberOffset:
    """Offset of the stage's sample numbers: sample ``tick`` has the number ``tick + offset``.

    It follows the median of a message, so that a single wrong number has no effect.
    """

    def __init__(self, offset: int) -> None:
        self.offset = offset

    def follow(self, message: Message) -> None:
        self.offset = sorted((message.batch.seq - message.tick).tolist())[message.tick.size // 2]


def run_adaptive(
    axis: Axis, plant: DisturbedPlant, sensor: DisturbedSensor, line: MessageLine, wanted: Motion, u_before_V: float,
    block: int, first_number: int, progress: LoopProgress = lambda _: None,
) -> LoopRecord:  # fmt: skip
    """Close the loop over the (n,) motion ``wanted``, n a multiple of ``block``.

    ``u_before_V``: applied before the first sample, V. ``first_number``: number of sample 0 in the stage's count.
    Raises what the plant raises and what the axis raises; an axis that works refuses nothing here.
    """
    n, dt_s = wanted.y_um.size, axis.dt_s
    for first in range(-idle_samples(dt_s, block), 0, block):
        u_rest_V = np.full(block, u_before_V)
        at_rest = line.carry(first, u_rest_V, plant.run(first, u_rest_V)[1])
        if at_rest is not None:
            axis.handle(at_rest.batch)
    true_um, read_um, u_V = np.zeros(n), np.zeros(n), np.zeros(n)
    flags = np.zeros(n, dtype=np.uint8)
    verdict, trouble = np.zeros(n, dtype=np.int16), np.zeros(n, dtype=np.int16)
    jumps = np.zeros(n, dtype=np.int64)
    verdicts, troubles = _NameCodes(NEVER_CAME), _NameCodes("")
    events: list[tuple[float, str, str]] = []
    commanded, count = PendingCommands(), _NumberOffset(first_number)
    before_V, newest = u_before_V, -1  # the last sample of the rest
    for first in range(0, n + block, block):
        part, held = slice(first, first + block), slice(first - block, first)
        if first < n:
            begin = first + count.offset
            # The block before is pending; the newest sample that can have come is that of the block before it.
            axis.update_age(max(0, first - block - 1 - newest) * dt_s)
            y_um, v_um_per_s, a_um_per_s2 = (values[part] for values in wanted)
            query = FeedforwardQuery(
                y_um, v_um_per_s, a_um_per_s2, u_before_V=before_V, pending=commanded.before(begin)
            )
            reply = axis.answer(query)
            u_V[part], flags[part] = reply.u_V, reply.flags
            before_V = float(reply.u_V[-1])
            commanded.take(begin, y_um, reply)
            true_um[part], now_um = plant.run(first, u_V[part])
            read_um[part] = sensor.read(first, now_um)
        if first == 0:
            continue
        # The samples of the block before arrive while this block is computed.
        message = line.carry(held.start, u_V[held], read_um[held])
        if message is not None:
            for tick, said in zip(message.tick.tolist(), axis.handle(message.batch), strict=True):
                verdict[tick] = verdicts(said)
            newest = held.stop - 1
            count.follow(message)
        # Known from the end of the block on; until then the value before.
        trouble[held] = trouble[held.start - 1] if held.start else 0
        trouble[held.stop - 1] = troubles(axis.newest.trouble)
        jumps[held] = axis.learner.counters().get("jumps", 0) if axis.learner is not None else 0
        events += [((held.stop - 1) * dt_s, *_name_and_detail(event)) for event in axis.take_events()]
        progress(held.stop)
    return LoopRecord(
        times(n, dt_s), wanted.y_um, true_um, read_um, u_V, flags, verdict, verdicts.known, trouble,
        troubles.known, jumps, tuple(events),
    )  # fmt: skip


def run_frozen(
    model: InverseModel, plant: DisturbedPlant, wanted: Motion, u_before_V: float, limits: Limits, block: int
) -> LoopRecord:
    """The same without learning: the identified model alone, its memory follows the reference, not the readings."""
    n = wanted.y_um.size
    idle = idle_samples(model.dt_s, block)
    plant.run(-idle, np.full(idle, u_before_V))
    answer = model.feedforward(*wanted, model.rest_memory(float(wanted.y_um[0])))
    u_V, flags = guard(answer.u_V, answer.inside, model.dt_s, limits, u_before_V)
    true_um, read_um = plant.run(0, u_V)
    none = np.zeros(n, dtype=np.int16)
    return LoopRecord(
        times(n, model.dt_s),
        wanted.y_um,
        true_um,
        read_um,
        u_V,
        flags,
        none,
        ("not_learning",),
        none,
        ("",),
        np.zeros(n, dtype=np.int64),
        (),
    )


def times(n: int, dt_s: float) -> FloatArray:
    """(n,) times, s, ``dt_s`` apart."""
    t_s: FloatArray = np.arange(n, dtype=np.float64) * dt_s
    return t_s


def idle_samples(dt_s: float, block: int) -> int:
    """Number of samples of the rest before the first block: whole blocks, at least two."""
    return max(2, math.ceil(IDLE_S / dt_s / block)) * block


def _name_and_detail(event: dict[str, Any]) -> tuple[str, str]:
    return str(event["event"]), str(event["detail"])
