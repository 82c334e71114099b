"""The runs of a rehearsal: the closed loop over a disturbed plant, and the frozen model beside it, sample by sample.

Before the first block the stage rests for ``IDLE_S``, and the axis gets these samples. A block is asked for while the
one before it is under way, see `lab.loop`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from dehyst.adaptive.types import FloatArray, InverseModel
from dehyst.lab.loop import Asker, turns
from dehyst.lab.rehearsal.disturbance import DisturbedPlant, DisturbedSensor, MessageLine
from dehyst.lab.rehearsal.reference import Motion
from dehyst.service.answers.guard import Limits, guard
from dehyst.service.server.axis import Axis

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
    jumps : jumps that the learner has believed up to then.
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
    verdicts, troubles = {NEVER_CAME: 0}, {"": 0}  # small integers for names
    ask, offset = Asker(axis, u_before_V=u_before_V), first_number  # of the stage's numbers from those of the samples
    newest = -1  # the last sample of the rest
    for run, asked in turns(n // block, 1):
        if run is not None:
            part = slice(run * block, (run + 1) * block)
            true_um[part], now_um = plant.run(part.start, u_V[part])
            read_um[part] = sensor.read(part.start, now_um)
            message = line.carry(part.start, u_V[part], read_um[part])
            if message is not None:
                for tick, said in zip(message.tick.tolist(), axis.handle(message.batch), strict=True):
                    verdict[tick] = verdicts.setdefault(said, len(verdicts))
                newest = part.stop - 1
                # The median of a message: a single wrong number has no effect.
                offset = sorted((message.batch.seq - message.tick).tolist())[message.tick.size // 2]
            # Known from the end of the block on; until then the value before.
            trouble[part] = trouble[part.start - 1] if part.start else 0
            trouble[part.stop - 1] = troubles.setdefault(axis.newest.trouble, len(troubles))
            jumps[part] = axis.learner.counters().get("jumps", 0) if axis.learner is not None else 0
            progress(part.stop)
        if asked is not None:
            part = slice(asked * block, (asked + 1) * block)
            # The block before is pending; the newest sample that can have come is that of the block before it.
            axis.update_age(max(0, part.start - block - 1 - newest) * dt_s)
            reply = ask(part.start + offset, [values[part] for values in wanted])
            u_V[part], flags[part] = reply.u_V, reply.flags
    return LoopRecord(
        times(n, dt_s), wanted.y_um, true_um, read_um, u_V, flags, verdict, tuple(verdicts), trouble,
        tuple(troubles), jumps,
    )  # fmt: skip


def run_frozen(
    model: InverseModel, memory: FloatArray, plant: DisturbedPlant, wanted: Motion, u_rest_V: float, led_V: FloatArray,
    limits: Limits, block: int,
) -> LoopRecord:  # fmt: skip
    """The same without learning: one model alone, whose memory follows the reference, not the readings.

    ``led_V``: (k,) voltages of the first samples, V. ``memory``: (m,) of the model after them. ``u_rest_V``: applied
    before the first sample, V.
    """
    n, led = wanted.y_um.size, led_V.size
    idle = idle_samples(model.dt_s, block)
    plant.run(-idle, np.full(idle, u_rest_V))
    own = Motion(*(values[led:] for values in wanted))
    answer = model.feedforward(*own, memory)
    before_V = float(led_V[-1]) if led else u_rest_V
    own_V, own_flags = guard(answer.u_V, answer.inside, model.dt_s, limits, before_V)
    u_V, flags = np.concatenate([led_V, own_V]), np.concatenate([np.zeros(led, dtype=np.uint8), own_flags])
    true_um, read_um = plant.run(0, u_V)
    none = np.zeros(n, dtype=np.int16)
    return LoopRecord(
        times(n, model.dt_s), wanted.y_um, true_um, read_um, u_V, flags, none, ("not_learning",), none, ("",),
        np.zeros(n, dtype=np.int64),
    )  # fmt: skip


def times(n: int, dt_s: float) -> FloatArray:
    """(n,) times, s, ``dt_s`` apart."""
    t_s: FloatArray = np.arange(n, dtype=np.float64) * dt_s
    return t_s


def idle_samples(dt_s: float, block: int) -> int:
    """Number of samples of the rest before the first block: whole blocks, at least two."""
    return max(2, math.ceil(IDLE_S / dt_s / block)) * block
