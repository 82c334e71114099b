"""Control and replay with a model that learns while it serves, in one process and without a clock.

Block by block, a snapshot that has seen no sample of the last ``delay_blocks`` blocks gives the voltages of the next
one. The stage runs on them, with feedback added sample by sample, and its samples then teach the model. That is what
the service does.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

from adaptive.errors import InputError
from adaptive.types import FloatArray, InverseModel, OnlineModel, Sample
from sim.signals.references import Reference
from sim.stage.closed_loop import PID, Run
from sim.stage.stage import Stage, StageState


@dataclass(frozen=True, slots=True)
class BlockConfig:
    """block : samples answered at once, >= 1. delay_blocks : age of the answering snapshot, blocks, >= 1.

    Raises InputError on smaller values.
    """

    block: int = 20
    delay_blocks: int = 3

    def __post_init__(self) -> None:
        if self.block < 1 or self.delay_blocks < 1:
            raise InputError(f"block, delay_blocks: got {self.block}, {self.delay_blocks}, expected at least 1 each")


def track_learning(
    stage: Stage,
    reference: Reference,
    online: OnlineModel,
    *,
    pid: PID | None = None,
    state: StageState | None = None,
    config: BlockConfig | None = None,
) -> Run:
    """Follow ``reference`` with the feedforward of a model that learns; ``online`` and ``state`` are advanced.

    Without ``state`` the stage starts at rest. The memory starts at rest at 0 µm and is passed from block to block.
    Limits and the integral of the feedback are handled as in ``sim.stage.closed_loop.track``.
    """
    config = config or BlockConfig()
    state = state or stage.initial_state()
    n, dt_s = reference.y_um.size, stage.config.dt_s
    first = state.k
    low, high = stage.config.u_min_V, stage.config.u_max_V
    y, u, forward, feedback = np.empty(n), np.empty(n), np.empty(n), np.zeros(n)
    snapshots: deque[InverseModel] = deque([online.snapshot()], maxlen=config.delay_blocks)
    memory = snapshots[0].rest_memory(0.0)
    fed = pid.initial_state() if pid is not None else None
    for start in range(0, n, config.block):
        part = slice(start, min(n, start + config.block))
        answer = snapshots[0].feedforward(
            reference.y_um[part], reference.v_um_per_s[part], reference.a_um_per_s2[part], memory
        )
        memory = answer.memory
        forward[part] = answer.u_V
        if pid is None or fed is None:
            u[part] = np.clip(answer.u_V, low, high)
            y[part], _ = stage.run(state, u[part])
        else:
            for k in range(part.start, part.stop):
                y[k] = stage.read(state)[0]
                feedback[k] = pid.step(fed, float(reference.y_um[k]) - y[k])
                wanted = float(forward[k]) + feedback[k]
                u[k] = min(max(wanted, low), high)
                fed.limit(wanted, float(u[k]))
                stage.step(state, float(u[k]))
        for k in range(part.start, part.stop):
            online.handle(Sample(first + k, (first + k) * dt_s, float(u[k]), float(y[k])))
        snapshots.append(online.snapshot())
    t_s = np.arange(first, first + n, dtype=np.float64) * dt_s
    return Run(t_s, reference.y_um, y, u, forward, feedback)


def replay(
    online: OnlineModel,
    motion: FloatArray,
    u_V: FloatArray,
    y_um: FloatArray,
    dt_s: float,
    config: BlockConfig | None = None,
) -> FloatArray:
    """Voltages (n,) V that a learning model would have given for a recorded motion, learning from it block by block.

    ``motion`` (n, 3) is smoothed displacement, velocity and acceleration; ``u_V``, ``y_um`` (n,) are the applied
    voltages and the readings. A block is answered by a snapshot that has seen neither it nor the ``delay_blocks - 1``
    blocks before. ``online`` is advanced. Raises InputError on bad shapes.
    """
    config = config or BlockConfig()
    n = u_V.size
    if motion.shape != (n, 3) or y_um.shape != (n,):
        raise InputError(f"motion, y_um: got {motion.shape}, {y_um.shape}, expected ({n}, 3) and ({n},)")
    y, v, a = (np.ascontiguousarray(motion[:, i]) for i in range(3))
    snapshots: deque[InverseModel] = deque([online.snapshot()], maxlen=config.delay_blocks)
    memory = snapshots[0].rest_memory(float(y[0]))
    out = np.empty(n)
    for start in range(0, n, config.block):
        part = slice(start, min(n, start + config.block))
        model = snapshots[0]
        out[part] = model.feedforward(y[part], v[part], a[part], memory).u_V
        memory = model.track(y[part], v[part], a[part], u_V[part], memory)
        for k in range(part.start, part.stop):
            online.handle(Sample(k, k * dt_s, float(u_V[k]), float(y_um[k])))
        snapshots.append(online.snapshot())
    return out
