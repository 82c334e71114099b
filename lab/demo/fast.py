"""The run in one process, as fast as possible: the same queries and answers, without a network."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np

from adaptive.types import FloatArray
from lab.demo.plan import MODELS, TEACHER, Plan
from lab.demo.result import DemoRun, empty
from service.client.client import PendingCommands
from service.protocol.query import FeedforwardQuery
from service.protocol.samples import SampleBatch
from service.server.axis import Axis
from service.storage.recorder import Recorder
from service.viewer.records import Diagnostics
from sim.stage.stage import Stage

#: Called with the number of ticks done and, by model, the mean absolute error of the last second, µm.
Progress = Callable[[int, dict[str, float]], None]


def run_fast(plan: Plan, axis: Axis, recorder: Recorder, progress: Progress) -> DemoRun:
    """Run the plan on twin stages; the teacher's samples go into ``axis``."""
    wanted = plan.reference()
    n, size, ahead = plan.ticks, plan.block, plan.lead // plan.block
    stage = Stage(plan.stage(changing=True))
    states = {name: stage.initial_state() for name in MODELS}
    u_V, y_um, std_V = empty(plan), empty(plan), empty(plan)
    memory: dict[str, FloatArray | None] = dict.fromkeys(MODELS)
    commanded = PendingCommands()
    last_V = {name: float("nan") for name in MODELS}
    durations, notes = [], []
    for block in range(n // size + ahead + 1):
        done = (block - ahead - 1) * size
        if done >= 0:
            part = slice(done, done + size)
            for name in MODELS:
                y_um[name][part] = stage.run(states[name], u_V[name][part])[0]
            seq = np.arange(part.start, part.stop)
            t_s = seq.astype(np.float64) * plan.dt_s
            batch = SampleBatch(seq, t_s, u_V[TEACHER][part], y_um[TEACHER][part])
            verdicts = axis.handle(batch)
            recorder.put(batch.seq, batch.t_s, batch.u_V, batch.y_um, verdicts)
            if done % (5 * size) == 0 and axis.learner is not None:
                told = axis.learner.diagnostics()
                if done % 1000:
                    told = {
                        key: value for key, value in told.items() if not key.startswith("window_y") and "_v_" not in key
                    }
                notes.append(Diagnostics(float(batch.t_s[-1]), int(seq[-1]), told))
            if (done + size) % 1000 == 0:
                tail = slice(max(0, done + size - 1000), done + size)
                progress(done + size, {k: float(np.mean(np.abs(wanted[0][tail] - y_um[k][tail]))) for k in MODELS})
        if block * size >= n:
            continue
        part = slice(block * size, (block + 1) * size)
        for name in MODELS:
            # The service tracks the teacher's stage; the other models carry their memory in the query.
            pending = commanded.before(part.start) if name == TEACHER else None
            query = FeedforwardQuery(
                wanted[0][part], wanted[1][part], wanted[2][part], memory[name], name, plan.as_of(block), last_V[name],
                pending,
            )  # fmt: skip
            begin = time.perf_counter()
            reply = axis.answer(query)
            durations.append(time.perf_counter() - begin)
            u_V[name][part], std_V[name][part] = reply.u_V, reply.std_V
            last_V[name] = float(reply.u_V[-1])
            if name == TEACHER:
                commanded.take(part.start, wanted[0][part], reply)
            else:
                memory[name] = reply.memory
    samples = {"sent": n, "received": axis.handled_seq + 1, "learnt": axis.gates.get("learnt", 0)}
    ticks = {"count": n, "late": 0, "bare_late": 0}
    return DemoRun(y_um, u_V, std_V, np.asarray(durations), 0, samples, ticks, notes)
