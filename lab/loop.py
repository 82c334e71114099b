"""The closed loop in lockstep: the real axis in this process, asked ahead of time as a client asks it, and a stage.

Time line, blocks of one length::

    block j is asked for when the axis has handled the samples of the blocks up to j - ahead - 1;
    the ``ahead`` blocks before it are under way.

Rehearsals, scenarios and the fast demonstration run by it. Nothing depends on a clock: the same seeds give the same
run. `stepped` is the loop of a controller that is asked sample by sample, with readings of an age.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple, Protocol

import numpy as np

from dehyst.adaptive.types import FloatArray
from dehyst.service.client.client import PendingCommands
from dehyst.service.protocol.query import NEWEST, FeedforwardQuery, Trajectory
from dehyst.service.protocol.samples import SampleBatch
from dehyst.service.server.axis import Axis
from dehyst.sim.stage.stage import Stage


def turns(blocks: int, ahead: int) -> Iterator[tuple[int | None, int | None]]:
    """(block to run and whose samples to hand over, block to ask for) in the order of the time line; None for none."""
    for block in range(blocks + ahead + 1):
        yield (block - ahead - 1 if block > ahead else None), (block if block < blocks else None)


class Asker:
    """Asks an axis for one block after the other, as one client does; each continues the voltage of the one before.

    Parameters
    ----------
    model : name of the model to ask; empty for the default. tracked : the axis tracks the memory from the samples of
    the stage that is driven; otherwise the queries carry it. u_before_V : voltage before the first block, V; NaN if
    there is none.
    """

    def __init__(self, axis: Axis, model: str = "", *, tracked: bool = True, u_before_V: float = float("nan")) -> None:
        self._axis, self._model, self._tracked, self._last_V = axis, model, tracked, u_before_V
        self._commanded = PendingCommands()
        self._memory: FloatArray | None = None

    def __call__(self, begin: int, motion: Sequence[FloatArray], as_of: int = NEWEST) -> Trajectory:
        """The answer for (n,) displacements, velocities and accelerations from sample ``begin`` on.

        ``as_of``: the last sample that the answering model may have learnt. Raises what the axis raises.
        """
        y_um, v_um_per_s, a_um_per_s2 = motion
        pending = self._commanded.before(begin) if self._tracked else None
        answer = self._axis.answer(
            FeedforwardQuery(
                y_um, v_um_per_s, a_um_per_s2, self._memory, self._model, as_of, self._last_V, pending
            )
        )  # fmt: skip
        self._last_V = float(answer.u_V[-1])
        if self._tracked:
            self._commanded.take(begin, y_um, answer)
        else:
            self._memory = answer.memory
        return answer


class Controller(Protocol):
    """What gives the voltages of a stage, sample by sample."""

    def read(self, k: int, u_V: float, y_um: float) -> None:
        """Take the reading of sample ``k``, µm, which got ``u_V``, V."""
        ...

    def voltage(self, k: int) -> float:
        """The voltage of sample ``k``, V."""
        ...


class Stepped(NamedTuple):
    """(n,) true positions and readings, µm, and voltages, V."""

    true_um: FloatArray
    read_um: FloatArray
    u_V: FloatArray


def stepped(
    controller: Controller, n: int, age: int, stage: Callable[[int, FloatArray], tuple[float, float]]
) -> Stepped:
    """The loop over n samples, with readings that come ``age`` samples late, at least 1.

    stage : (true position, reading), µm, of a sample by its number and (1,) voltage, V.
    """
    true_um, read_um, u_V = np.zeros(n), np.zeros(n), np.zeros(n)
    for k in range(n):
        if k >= age:
            controller.read(k - age, u_V.item(k - age), read_um.item(k - age))
        u_V[k] = controller.voltage(k)
        true_um[k], read_um[k] = stage(k, u_V[k : k + 1])
    return Stepped(true_um, read_um, u_V)


class Twins:
    """One stage for each model, all alike: (n,) voltages, V, and readings, µm, by model."""

    def __init__(self, stage: Stage, models: Sequence[str], n: int) -> None:
        self.u_V = {name: np.zeros(n) for name in models}
        self.y_um = {name: np.zeros(n) for name in models}
        self._stage = stage
        self._states = {name: stage.initial_state() for name in models}

    def run(self, part: slice) -> None:
        """Run all stages over these samples with the voltages in ``u_V``."""
        for name, state in self._states.items():
            self.y_um[name][part] = self._stage.run(state, self.u_V[name][part])[0]


def samples(first: int, dt_s: float, u_V: FloatArray, y_um: FloatArray) -> SampleBatch:
    """(n,) voltages and readings as the message of a stage whose sample ``first`` they begin with."""
    seq = np.arange(first, first + u_V.size)
    return SampleBatch(seq, seq.astype(np.float64) * dt_s, u_V, y_um)
