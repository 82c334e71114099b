"""The serving process of a fleet: one session, one thread that learns, replies from the newest snapshot."""

from __future__ import annotations

import math
import os
import queue
import secrets
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import replace
from typing import Any, Final

import numpy as np
import zenoh
from numpy.typing import NDArray

from dehyst.adaptive.compiled import compiled
from dehyst.adaptive.errors import DehystError
from dehyst.adaptive.fleet.fleet import Fleet, FleetConfig, FleetSnapshot
from dehyst.adaptive.inverse_model import LssvmInverse
from dehyst.adaptive.online.gates import OUTCOMES
from dehyst.adaptive.types import BoolArray, FloatArray, MovingPart
from dehyst.service.answers.guard import Limits, limit
from dehyst.service.config.learner import learner_config
from dehyst.service.config.settings import LEARN, ServeConfig
from dehyst.service.fleet.checkpoints import FleetCheckpoints
from dehyst.service.fleet.settings import FleetSettings
from dehyst.service.fleet.wire import REFUSED, FleetMessage, decode_fleet, encode_fleet
from dehyst.service.operating.server import FREEZE, THAW, Journal, OperationsServer
from dehyst.service.operating.verbs import Outcome, Request, take
from dehyst.service.protocol.container import JSON, fields_of, to_json
from dehyst.service.protocol.delta import checksum, encode_delta
from dehyst.service.protocol.errors import FieldError, ServiceError
from dehyst.service.protocol.keys import Keys
from dehyst.service.protocol.model import encode_model
from dehyst.service.protocol.samples import FLEET_CHANGES, FLEET_QUERY, FLEET_REPLY, FLEET_SAMPLES
from dehyst.service.runtime.session import open_service
from dehyst.service.security.authenticator import HeardSamples
from dehyst.service.server.process import authenticator_of
from dehyst.service.server.query_answers import guarded
from dehyst.service.storage.model_file import read_bundle

#: Name of a fleet in the keys, in place of an axis.
NAME: Final = "fleet"
_COUNTED: Final = ("received", "dropped", "malformed", "missing", "unknown_axes", "queries", "query_errors",
                   "points_refused", "waiting")  # fmt: skip
#: Axes that the summary lists, worst first; time between two statuses, s.
_WORST, _STATUS_S = 10, 1.0
#: Returns axes to their checkpoints. Most axes that are written before an operator is answered.
ROLLBACK: Final = "rollback"
_WRITTEN_AT_ONCE: Final = 16
#: Most axes whose models are followed at a time, and time between two whole models of one, s.
_MOST_FOLLOWED, _WHOLE_S = 64, 1.0


def load_fleet(settings: FleetSettings) -> Fleet:
    """The fleet that ``settings`` describe. Raises ModelFileError or InputError saying what does not fit."""
    models: list[LssvmInverse] = []
    for path in settings.models:
        model = read_bundle(path).models.get(LEARN)
        if not isinstance(model, LssvmInverse):
            raise FieldError("fleet.models", str(path), f"a model file with {LEARN!r}", "identify with --inputs memory")
        models.append(model)
    if len(models) == 1:
        f = models[0].features
        gains = settings.gains or (1.0,) * settings.axes
        models = [replace(models[0], features=replace(f, gain=gain * f.gain)) for gain in gains]
    learner = learner_config(settings.learner, settings.limits, "fleet.learner")
    try:
        fleet = Fleet(models, FleetConfig(learner, settings.device, threads=settings.threads))
    except ImportError as error:
        raise FieldError(
            "[fleet]", f"device {settings.device!r}, without torch ({error})", "torch, for a device but the processor",
            "pip install 'dehyst[torch]'",
        ) from error  # fmt: skip
    fleet.warm()
    return fleet


def answer(
    snapshot: FleetSnapshot, tracked: FloatArray, limits: Limits, query: FleetMessage, seq: int
) -> tuple[bytes, int]:
    """The payload of the reply to a query, and the number of its points that were refused. Pure."""
    q, numbers = query.parts, query.first + np.arange(query.axes)
    unknown = numbers >= len(tracked)
    at = np.where(unknown, 0, numbers)
    if q["memory"] is not None and q["memory"].shape[1] != tracked.shape[1]:
        raise FieldError("columns", q["memory"].shape[1], f"{tracked.shape[1]}, the size of a memory")
    given = np.stack([q[name].T for name in ("y_um", "v_um_per_s", "a_um_per_s2")])
    refused = ~np.isfinite(given).all(0) | ~((given[0] >= limits.y_min_um) & (given[0] <= limits.y_max_um))
    memory = tracked[at]
    if q["memory"] is not None:
        sound = np.isfinite(q["memory"]).all(1)
        refused |= ~sound[:, None]
        memory[sound] = q["memory"][sound]
    # From its first refused point on, an axis' memory would be unknown.
    refused = np.logical_or.accumulate(refused | unknown[:, None], axis=1)
    y_um, v_um_per_s, a_um_per_s2 = np.where(refused, 0.0, given)
    u, std, inside, after = snapshot.feedforward(y_um, v_um_per_s, a_um_per_s2, memory, at)
    flags = np.zeros(refused.shape, dtype=np.uint8)
    before = np.full(query.axes, np.nan) if q["u_before_V"] is None else q["u_before_V"]
    _limit_all(u, inside, before, limits.u_min_V, limits.u_max_V, limits.slew_V_per_s * snapshot.bases[0].dt_s, flags)
    u[refused], std[refused], flags[refused] = np.nan, np.nan, REFUSED
    after = np.where(refused[:, -1:], memory, after)
    after[unknown] = np.nan
    parts = {"snapshot_seq": [seq], "u_V": u.T, "std_V": std.T, "memory": after, "flags": flags.T}
    return encode_fleet(FLEET_REPLY, query.first, **parts), int(refused.sum())


@compiled
def _limit_all(
    u: FloatArray, inside: BoolArray, before: FloatArray, low_V: float, high_V: float, step_V: float,
    flags: NDArray[np.uint8],
) -> None:  # fmt: skip
    """`service.answers.guard.limit` of each axis, in place."""
    for b in range(u.shape[0]):
        limit(u[b], inside[b], before[b], low_V, high_V, step_V, flags[b])


class _Followed:
    """The model of one axis for those that follow it. ``lately`` : whether somebody subscribed at the last look.

    ``whole`` : payload of the last whole model, which changes are of.
    """

    def __init__(self, publisher: Any) -> None:
        self.publisher, self.lately, self.whole = publisher, True, b""
        self._whole_s, self._seq, self._bias_V = -math.inf, -1, 0.0

    def next(self, model: LssvmInverse, memory: FloatArray, part: MovingPart | None, now_s: float) -> bytes:
        """What followers get of a model at ``now_s`` (``time.monotonic``); empty where nothing is new."""
        if part is None or now_s - self._whole_s >= _WHOLE_S:
            whole = encode_model(LEARN, model, model.seq, memory)
            if whole == self.whole:
                return b""
            self.whole, self._whole_s, self._seq = whole, now_s, model.seq
            self._bias_V = 0.0 if part is None else float(model.beta[0] - part.beta[0])
            return whole
        if model.seq == self._seq:
            return b""
        self._seq = model.seq
        part.beta[0] += self._bias_V
        return encode_delta(model.seq, checksum(self.whole), part, memory)


class FleetService:
    """A running fleet; use as a context manager. The thread ``learn-fleet`` owns the fleet."""

    def __init__(self, config: ServeConfig) -> None:
        assert config.fleet is not None
        self.config, self.settings = config, config.fleet
        self.keys = Keys(config.stage, NAME)
        self._by = authenticator_of(config)
        self._heard = HeardSamples(self._by, self.keys.sample)
        self.instance = f"i{os.getpid()}-{secrets.token_hex(4)}"
        self._fleet = load_fleet(self.settings)
        self._checkpoints = None
        self._durable = False
        kept = self.settings.checkpoints is not None
        verbs = dict.fromkeys((FREEZE, THAW, ROLLBACK) if kept else (FREEZE, THAW), self._apply)
        self._operations = OperationsServer(
            self.keys, self.instance, verbs, Journal(self.settings.checkpoints), lambda *_: None,
            settle=lambda: self._durable, replayed=False, authenticator=self._by,
        )  # fmt: skip
        if self.settings.checkpoints is not None:
            folder, period_s = self.settings.checkpoints, self.settings.checkpoint_s
            self._checkpoints = FleetCheckpoints(self._fleet, folder, config.stage, self.instance, period_s)
            self._checkpoints.restore(range(self.settings.axes))
        self._renew(-1)
        self._published = self._newest[0].linear
        #: The axes that are followed.
        self._followed: dict[int, _Followed] = {}
        self._session: Any = None
        self._queue: queue.Queue[FleetMessage | Callable[[], None]] = queue.Queue()
        self._counts = dict.fromkeys(_COUNTED, 0)
        self._counting = threading.Lock()
        self._stopping = threading.Event()
        self._ending = ExitStack()

    def __enter__(self) -> FleetService:
        config, keys = self.config, self.keys
        with ExitStack() as ending:
            self._session = session = open_service(config.listen, config.connect, config.zenoh_config, config.lease_s)
            ending.callback(session.close)
            publisher = session.declare_publisher(keys.model)
            ending.callback(publisher.undeclare)
            if self._checkpoints is not None:
                ending.callback(self._checkpoints.close)
            thread = threading.Thread(target=self._run, args=(publisher,), name="learn-fleet")
            thread.start()
            ending.callback(self._stop, thread)
            for entity in (
                session.declare_subscriber(keys.sample, self._on_samples),
                session.declare_queryable(keys.feedforward, self._answers(keys.feedforward, self._feedforward)),
                session.declare_queryable(keys.model, self._in_turn(keys.model, self._model)),
                session.declare_queryable(keys.status, self._in_turn(keys.status, self._status_reply)),
                session.declare_queryable(
                    keys.operate, self._in_turn(keys.operate, self._operations.handle, self._operations.check)
                ),
                # Last, because alive means callable.
                session.liveliness().declare_token(keys.alive(self.instance)),
            ):
                ending.callback(entity.undeclare)
            self._ending = ending.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._ending.close()

    def _stop(self, thread: threading.Thread) -> None:
        self._stopping.set()
        self._queue.put(lambda: None)
        thread.join()

    def ready(self) -> dict[str, Any]:
        """Fields of the line that `dehyst serve` prints when it is ready."""
        return {
            "ready": True, "instance": self.instance, "role": "primary", "synced": True, "stage": self.config.stage,
            "listen": list(self.config.listen), "connect": list(self.config.connect), "key": self.keys.base,
            "key_file": None if self._by.path is None else str(self._by.path),
            "axes": {NAME: [f"{self.settings.axes} axes", self.settings.device]},
        }  # fmt: skip

    # ---- zenoh's threads

    def _count(self, **more: int) -> None:
        with self._counting:
            for name, value in more.items():
                self._counts[name] += value

    def _on_samples(self, sample: zenoh.Sample) -> None:
        try:
            if (payload := self._heard.take(sample)) is None:
                return
            batch = decode_fleet(FLEET_SAMPLES, payload)
        except DehystError:
            self._count(malformed=1)
            return
        with self._counting:
            room = self._counts["waiting"] + batch.rows <= self.settings.queue_samples
            self._counts["received" if room else "dropped"] += batch.rows
            self._counts["waiting"] += batch.rows if room else 0
        if room:
            self._queue.put(batch)

    def _answers(
        self, key: str, answer: Callable[[bytes], bytes], check: Callable[[zenoh.Query], None] = lambda _: None
    ) -> Callable[[zenoh.Query], None]:
        """A callback that counts and answers the queries to ``key`` by their payload, if ``check`` does not raise."""

        def counted(query: zenoh.Query) -> bytes:
            self._count(queries=1)
            check(query)
            return answer(query.payload.to_bytes() if query.payload is not None else b"")

        return guarded(key, counted, lambda _: self._count(query_errors=1), authenticator=self._by)

    def _in_turn(
        self, key: str, answer: Callable[[bytes], bytes], check: Callable[[zenoh.Query], None] = lambda _: None
    ) -> Callable[[zenoh.Query], None]:
        """The same in the thread that learns, because it reads the learners."""
        callback = self._answers(key, answer, check)
        return lambda query: self._queue.put(lambda: callback(query))

    def _feedforward(self, payload: bytes) -> bytes:
        snapshot, memory, seq = self._newest
        query = decode_fleet(FLEET_QUERY, payload)
        reply, refused = answer(snapshot, memory, self.settings.limits, query, seq)
        self._count(points_refused=refused)
        return reply

    # ---- the thread that learns

    def _run(self, publisher: Any) -> None:
        handled, told_s, changed_s = 0, 0.0, 0.0
        while not self._stopping.is_set():
            try:
                item = self._queue.get(timeout=0.1)
            except queue.Empty:
                item = None
            if isinstance(item, FleetMessage):
                before, handled = handled // self.settings.snapshot_every, handled + self._learn(item)
                if handled // self.settings.snapshot_every > before:
                    self._renew(int(item.parts["seq"].max()))
                if self._checkpoints is not None:
                    self._checkpoints.write_due()
            elif item is not None:
                item()
            now_s = time.monotonic()
            if now_s - told_s >= _STATUS_S:
                told_s = now_s
                status, key = to_json(self.status()), self.keys.status
                self._session.put(key, status, encoding=JSON, attachment=self._by.published(key, status))
            if now_s - changed_s >= 1.0 / self.settings.model_hz:
                changed_s = now_s
                self._publish_changes(publisher)
                self._publish_followed()

    def _renew(self, seq: int) -> None:
        """Answer from the models as they stand after sample ``seq``."""
        self._newest = self._fleet.snapshot(), self._fleet.memory(), seq

    def _learn(self, batch: FleetMessage) -> int:
        """Take all samples of a message; returns their number."""
        axes, k, p = self.settings.axes, batch.rows, batch.parts
        here = slice(batch.first, min(batch.first + batch.axes, axes))
        known = max(here.stop - here.start, 0)
        u, y = np.full((2, k, axes), np.nan)
        u[:, here], y[:, here] = p["u_V"][:, :known], p["y_um"][:, :known]
        present = ~(np.isnan(u) & np.isnan(y))
        for i in range(k):
            self._fleet.step(p["seq"][i], p["t_s"][i], u[i], y[i], present[i])
        self._count(missing=int((~present[:, here]).sum()), unknown_axes=k * (batch.axes - known), waiting=-k)
        return k

    def _publish_changes(self, publisher: Any) -> None:
        """Send the linear parts and frames that have changed since the last time, to those that follow."""
        if not publisher.matching_status.matching:
            return
        snapshot, _, seq = self._newest
        now = snapshot.linear
        axes = np.flatnonzero(np.any(now != self._published, axis=1))
        self._published = now
        if axes.size:
            frames, beta = now[axes, :2], now[axes, 2:]
            changes = encode_fleet(FLEET_CHANGES, snapshot_seq=[seq], axes=axes, frames=frames, beta=beta)
            publisher.put(changes, attachment=self._by.published(self.keys.model, changes))

    def _publish_followed(self) -> None:
        """Send what has moved in the models of single axes to those that follow them, now and then a whole model."""
        memory = self._fleet.memory() if self._followed else None
        for axis, followed in list(self._followed.items()):
            follows = followed.publisher.matching_status.matching
            # Just after it was declared, a publisher may not know of its subscribers yet.
            if not (follows or followed.lately):
                followed.publisher.undeclare()
                del self._followed[axis]
                continue
            followed.lately = follows
            payload, key = (
                followed.next(*self._state_of(axis, memory), time.monotonic()),
                f"{self.keys.model_delta}/{axis}",
            )
            if payload:
                followed.publisher.put(payload, attachment=self._by.published(key, payload))

    def _state_of(self, axis: int, memory: Any) -> tuple[LssvmInverse, FloatArray, MovingPart | None]:
        """(model as it is served, its memory, what moves in it, None for one that is held)."""
        held, learner = self._fleet.held.get(axis), self._fleet.learner_of(axis)
        return held or learner.snapshot(), memory[axis], None if held else learner.moving()

    def _checked(self, axis: object, field: str) -> int:
        if isinstance(axis, bool) or not isinstance(axis, int) or not 0 <= axis < self.settings.axes:
            raise FieldError(field, repr(axis)[:80], f"an axis from 0 to {self.settings.axes - 1}")
        return axis

    def _model(self, payload: bytes) -> bytes:
        """The whole model of an axis; with "changes" the one that the next changes are of."""
        fields = fields_of(payload)
        axis = self._checked(fields.get("axis"), "axis")
        followed = self._followed.get(axis)
        if followed is None or not fields.get("changes"):
            model, memory, _ = state = self._state_of(axis, self._fleet.memory())
            if not fields.get("changes"):
                return encode_model(LEARN, model, model.seq, memory)
            if len(self._followed) >= _MOST_FOLLOWED:
                raise ServiceError(f"{_MOST_FOLLOWED} axes are followed already: ask for whole models, or later")
            followed = _Followed(self._session.declare_publisher(f"{self.keys.model_delta}/{axis}"))
            followed.next(*state, time.monotonic())
            self._followed[axis] = followed
        return followed.whole

    def _status_reply(self, payload: bytes) -> bytes:
        axis = fields_of(payload).get("axis")
        return to_json(self.status() if axis is None else self.axis_status(self._checked(axis, "axis")))

    def _apply(self, request: Request) -> Outcome:
        """Carry out a verb of the operator for the axes that it names."""
        kept = self._checkpoints
        (axes,) = take(request.arguments, axes=list)
        for axis in axes:
            self._checked(axis, "arguments.axes")
        if request.verb == ROLLBACK and kept is not None:
            axes = kept.restore(axes)
            if not axes:
                raise ServiceError(f"none of these axes has a checkpoint that fits; {kept.error}")
        else:
            self._fleet.freeze(axes, request.verb == FREEZE)
        # So many at once would hold up the samples; the others are written in their turn.
        self._durable = kept is not None and len(axes) <= _WRITTEN_AT_ONCE and kept.write(axes)
        self._renew(int(self._fleet.snapshot().seq.max()))
        return self._newest[2], {"axes": axes}

    def status(self) -> dict[str, Any]:
        """The summary: counts, and the worst axes first."""
        fleet, kept = self._fleet, self._checkpoints
        errors, troubles, outcomes = fleet.rms_error_pct(), fleet.troubles(), fleet.outcomes()
        # An axis in trouble is worse than any that learns.
        order = sorted(range(fleet.axes), key=lambda axis: (axis not in troubles, -errors[axis]))
        with self._counting:
            counts = dict(self._counts)
        return {
            "role": "primary", "instance": self.instance, "stage": self.config.stage, "axes": fleet.axes,
            "seq": self._newest[2], "samples": counts,
            "gates": {name: int(n) for name, n in zip(OUTCOMES, outcomes.sum(0), strict=True)},
            "rms_error_pct": {"median": float(np.median(errors)), "max": float(errors.max())},
            "apart": len(fleet.apart), "in_trouble": len(troubles), "frozen": sorted(fleet.held),
            "checkpoints": None if kept is None else {**kept.counts, "error": kept.error},
            "operations": self._operations.counters(), "followed": len(self._followed),
            "worst": [{"axis": axis, "rms_error_pct": float(errors[axis]), "trouble": troubles.get(axis, "")}
                      for axis in order[:_WORST]],
        }  # fmt: skip

    def axis_status(self, axis: int) -> dict[str, Any]:
        """The status of one axis: counters and figures of its learner."""
        learner = self._fleet.learner_of(axis)
        figures = {name: value for name, value in learner.diagnostics().items() if not isinstance(value, list)}
        return {
            "axis": axis, "seq": learner.seq, "trouble": learner.trouble, "why": learner.why,
            "apart": axis in self._fleet.apart, "gates": learner.counters(), "figures": figures,
        }  # fmt: skip
