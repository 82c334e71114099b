"""The life of an axis, as one loop: take, learn, take snapshots, keep checkpoints, record, diagnose, tune, publish.

`AxisLoop.run` is the thread that handles samples; nothing else changes an axis. What it must not wait for is done by
threads that it only wakes or fills a queue of: the disk by the recorder's and the checkpoints' writer, publishing by
the thread of the process. docs/architecture.md lists all threads.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Final

from dehyst.service.background.retuner import Retuner
from dehyst.service.intake.sample_queue import Arrived, Job, SampleQueue, Thinner
from dehyst.service.intake.sequence import AHEAD
from dehyst.service.protocol.samples import SampleBatch
from dehyst.service.server.axis import Axis
from dehyst.service.server.learner_supervisor import standing_of

if TYPE_CHECKING:
    from dehyst.service.background.watcher import Watcher
    from dehyst.service.storage.recorder import Recorder

#: Verdict, in a recording, on samples that were never handled because too many waited.
DROPPED: Final = "dropped"
#: Verdict, in a recording, on samples that were left out because the learner cannot keep up.
THINNED: Final = "thinned"
#: Verdict, in a recording, on samples that still waited when the service stopped; the next start learns them.
WAITED: Final = "waited"
#: Longest time for which the samples that wait are handled at the end, s.
DRAIN_S: Final = 0.5

#: Interval at which diagnostics are read, s of samples, and how many such intervals pass between two readings of the
#: window's points.
DIAGNOSTICS_S: Final = 0.05
_WINDOW_EVERY: Final = 20
_WINDOW_FIELDS: Final = ("window_y_um", "window_v_um_per_s", "window_u_V")

#: Returns the part of a batch to handle now, or None: a standby holds samples back until it has a state.
Gate = Callable[[SampleBatch], SampleBatch | None]


class LearnerFigures:
    """What a learner reports of itself, copied in the thread of the axis for others to read; replaced as a whole.

    Attributes
    ----------
    counters : samples by outcome, and numerical events. standing : champion and scores; None without a competition.
    diagnostics : errors and gain, with ``seq`` and ``t_s``; the window's points once a second.
    """

    def __init__(self, axis: Axis) -> None:
        self.counters: dict[str, int] = {}
        self.standing: dict[str, Any] | None = None
        self.diagnostics: dict[str, Any] = {}
        self._axis = axis
        self._followed = False
        self._next_s = 0.0
        self._readings = 0

    def follow(self, followed: bool) -> None:
        """Whether somebody subscribes to the diagnostics; if not, they are read once a second, for the status."""
        self._followed = followed

    def read(self) -> None:
        """Read what is due; after a snapshot, in the thread of the axis."""
        learner, newest = self._axis.learner, self._axis.newest
        if learner is None or 0.0 <= self._next_s - newest.t_s <= DIAGNOSTICS_S:
            return
        self._next_s = newest.t_s + DIAGNOSTICS_S
        self.counters = dict(learner.counters())
        self.standing = standing_of(learner)
        with_window = self._readings % _WINDOW_EVERY == 0
        self._readings += 1
        if not self._followed and not with_window:
            return
        diagnostics = learner.diagnostics()
        if not diagnostics:
            return
        if not with_window:
            diagnostics = {name: value for name, value in diagnostics.items() if name not in _WINDOW_FIELDS}
        self.diagnostics = {"seq": newest.seq, "t_s": newest.t_s, **diagnostics}


class AxisLoop:
    """Owns the thread of one axis, and the parts that see its samples.

    Parameters
    ----------
    queue : where samples and jobs come from.
    announce : wakes the publishing thread after a new snapshot or a job.
    sink : records samples. watcher : diagnoses. retuner : tunes the learner, only while this instance serves.
    on_snapshot : called after each snapshot, at its sample: the checkpoints.
    """

    def __init__(
        self,
        axis: Axis,
        queue: SampleQueue,
        announce: Callable[[], None],
        sink: Recorder | None = None,
        watcher: Watcher | None = None,
        retuner: Retuner | None = None,
        on_snapshot: Callable[[], None] | None = None,
    ) -> None:
        self.axis = axis
        self.queue = queue
        self.sink = sink
        self.watcher = watcher
        self.retuner = retuner
        self.figures = LearnerFigures(axis)
        self.thinner = Thinner(axis.dt_s, queue.capacity)
        self._announce = announce
        self._on_snapshot = on_snapshot
        self._gate: Gate | None = None
        self._tunes = False
        #: Messages that were dropped because they could never fit into the queue.
        self._too_long = 0
        self._thread = threading.Thread(target=self.run, name=f"learn-{axis.config.name}")

    def run(self) -> None:
        """The thread of the axis, until the queue is closed and empty."""
        while (item := self.queue.take()) is not None:
            if isinstance(item, Job):  # an operator's command, a copy of the state, a state taken over
                item.run()
                del item  # an exception in it refers to the work
                self._announce()
                continue
            self.take(item)

    def take(self, item: Arrived) -> None:
        """Handle what the queue has handed out; in the thread of the axis."""
        handled = True
        self.axis.sequence.leave_out(item.left_out)
        try:
            self.handle(item.batch)
        except Exception as error:
            # The samples after it are handled: clients wait for their snapshots.
            handled = False
            self.axis.note("internal_error", f"handling samples: {type(error).__name__}: {error}")
        self.queue.finish(item, handled)

    def handle(self, batch: SampleBatch) -> None:
        """One batch through the whole axis; in the thread of the axis, or before it has started."""
        admitted = batch if self._gate is None else self._gate(batch)  # a standby may hold it back
        if admitted is None:
            return
        axis, batch, before = self.axis, admitted, self.axis.newest
        verdicts = axis.handle(batch, self._on_snapshot)  # learn; snapshots; a checkpoint where one is due
        if self.sink is not None:
            self.sink.put(batch.seq, batch.t_s, batch.u_V, batch.y_um, verdicts)
        if self.watcher is not None:
            # A number far ahead is refused; to a watcher it would make all that follow old.
            near = [verdict != AHEAD for verdict in verdicts]
            if any(near):
                self.watcher.take(batch if all(near) else batch.where(near))
        if self.retuner is not None and self._tunes:
            self.retuner.step(axis)
        if axis.newest is not before:
            self.figures.read()
            self._announce()  # the publishing thread sends models, diagnostics, status and events
        elif axis.moves.waiting:
            self._announce()

    # ---- from other threads

    def offer(self, batch: SampleBatch) -> bool:
        """Queue samples for the axis; False if they were dropped because it is too far behind.

        Where the queue fills faster than it is emptied, samples are thinned by a factor that an event states.
        """
        if self.thinner.watch(self.queue.waiting, time.monotonic()):
            self._note_thinning()
        kept, left_out = self.thinner.split(batch)
        if left_out is not None:
            self.queue.leave_out(len(left_out))
            if self.sink is not None:
                self.sink.put_aside(left_out.seq, left_out.t_s, left_out.u_V, left_out.y_um, THINNED)
        return kept is None or self._queue(kept)

    def _note_thinning(self) -> None:
        factor = self.thinner.factor
        if factor == 1:
            self.axis.note("thinning_ended", "the learner keeps up: all samples are learnt again", factor=1)
            return
        detail = f"the learner cannot keep up: it takes one stretch in {factor}, the others are recorded aside"
        self.axis.note("thinned", detail, factor=factor)

    def _queue(self, batch: SampleBatch) -> bool:
        dropped_before = self.queue.dropped
        if self.queue.put(batch):
            return True
        capacity = self.queue.capacity
        if len(batch) > capacity:
            if not self._too_long:
                detail = (
                    f"a message of {len(batch)} samples is longer than queue_samples, {capacity}: send shorter ones"
                )
                self.axis.note("samples_dropped", detail)
            self._too_long += 1
        elif not dropped_before:
            self.axis.note("samples_dropped", "the learner is behind and its queue is full; see the status")
        if self.sink is not None:
            # They have no place in the order in which the others are handled.
            self.sink.put_aside(batch.seq, batch.t_s, batch.u_V, batch.y_um, DROPPED)
        return False

    def set_gate(self, gate: Gate | None) -> None:
        """Pass batches through ``gate`` before they are handled. Before the start, or from the thread of the axis."""
        self._gate = gate

    def set_tuning(self, tunes: bool) -> None:
        """Whether to tune the learner: a standby only adopts what the serving instance announces."""
        self._tunes = tunes

    @property
    def tuner(self) -> Retuner | None:
        """The retuner while it tunes, else None."""
        return self.retuner if self._tunes else None

    def start(self) -> None:
        """Begin to handle samples."""
        self.queue.serve(self._thread)
        self._thread.start()

    def close(self) -> None:
        """Handle what is queued, for `DRAIN_S` at most, then end the thread; the rest is recorded without being learnt.

        It is recorded as the next in the order of handling, so that a start from the last checkpoint learns it.
        """
        self.queue.close(DRAIN_S)
        if self._thread.is_alive():
            self._thread.join()
        left = self.queue.leave()
        if not left:
            return
        for batch in left:
            if self.sink is not None:
                self.sink.put(batch.seq, batch.t_s, batch.u_V, batch.y_um, WAITED)
        config = self.axis.config
        learns = "and the next start learns them" if config.checkpoints is not None else "and are not learnt"
        where = "lost: nothing is recorded" if self.sink is None else f"in the recording, {learns}"
        self.axis.note("stopped_behind", f"{sum(map(len, left))} samples still waited; they are {where}")
