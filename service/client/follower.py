"""A follower: holds the newest state of a model in the caller's process and answers there, without the wire.

It takes whole models, and changes of them (`service.protocol.delta`). Changes of a whole model that has not come are
left out, and it is fetched; until then the last good state answers. What does not carry the authenticator of the
service is passed over, as is a model of another sample time.
"""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from collections.abc import Callable
from typing import Any, Final

import numpy as np
import zenoh
from numpy.typing import ArrayLike, NDArray

from dehyst.adaptive.errors import DehystError
from dehyst.adaptive.inverse_model import LssvmInverse
from dehyst.adaptive.types import FloatArray, InverseModel
from dehyst.baselines.competition.champion import ChampionInverse
from dehyst.service.answers.answering import begin_from, derivatives
from dehyst.service.answers.correcting import Answer, Correcting, Motion
from dehyst.service.answers.fallback import FADE_S, FADE_SAMPLES, Rules, answer_safely
from dehyst.service.answers.guard import Limits, check_domain, guard, limit_voltage
from dehyst.service.answers.which_model import Answering, answering, seen_in, trust_by_age
from dehyst.service.protocol.delta import Delta, checksum, decode_delta, moved
from dehyst.service.protocol.errors import FieldError
from dehyst.service.protocol.model import ModelMessage, decode_model
from dehyst.service.protocol.query import (
    BLENDED,
    NEWEST,
    NOT_FINITE_REPLACED,
    OUTSIDE_DOMAIN,
    STALE,
    STAND_IN,
    FeedforwardQuery,
    Trajectory,
)
from dehyst.service.protocol.samples import DELTA, check_seq, column, number, sequence, waiting_time
from dehyst.service.security.authenticator import NO_KEY, Heard

#: Voltage below which what fades has faded, V.
_FADED_V: Final = 1e-9

#: How long `Follower.close` waits for a fetch, s.
_CLOSE_S: Final = 2.0
#: Pause between two fetches of the whole model, s.
_FETCH_S: Final = 1.0


class Follower:
    """Evaluates the newest state of one model, with the hysteresis memory and the limits of the caller's axis.

    Every answer advances :attr:`memory`: consecutive points are one trajectory. The answers equal those of the service
    from the same state. One thread asks; zenoh's thread delivers.

    Parameters
    ----------
    key : where models, or their changes, are published; None: the model does not change.
    fetch : asks for the whole model. keep : newest states that `answer` can go back to.
    heard : decides which publications are the service's; None: all. ``fetch`` tells it who answered.
    dt_s : sample time of the axis, s; NaN: that of the first model.
    correcting : corrects the voltages by readings (docs/correction.md); None: feedforward alone.

    Attributes
    ----------
    memory : (m,) hysteresis memory after the last answered point.
    correcting : what corrects the voltages, to look at and to switch; None: nothing does.
    limits : of the axis; a client replaces them when the service has others.
    received, refused : counts of models taken, whole or as changes, and of unusable messages.
    last_error : why the last one was refused.
    lost : count of changes whose whole model had not come.
    last_flags : flags of the last voltage (see :func:`service.protocol.query.flag_names`).
    last_std_V : one standard deviation of the last voltage, V; NaN if the model does not state it or before any answer.
    last_trajectory : the last answer of :meth:`trajectory`, with deviations and stand-in; None before any.
    """

    def __init__(
        self,
        session: zenoh.Session,
        key: str | None,
        name: str,
        fetch: Callable[[], bytes],
        limits: Limits,
        memory: ArrayLike | None = None,
        *,
        keep: int = 1,
        heard: Heard | None = None,
        dt_s: float = math.nan,
        correcting: Correcting | None = None,
    ) -> None:
        self.limits = limits
        self.name = name
        self._fetch, self._dt_s = fetch, dt_s
        self._heard = heard or Heard(NO_KEY, "")
        self._fetching: threading.Thread | None = None
        self._fetched_s = -math.inf
        #: Whether the last message could not be used without another whole model.
        self._missing = False
        self._asking, self._closing = threading.Lock(), threading.Event()
        self.received = self.lost = 0
        self._refused = 0
        self.last_error = ""
        #: The last whole model, and its checksum.
        self._whole: tuple[ModelMessage, int] | None = None
        #: The last change of a whole model that has not come yet: it may be the last one for long.
        self._left: Delta | None = None
        self._taking = threading.Lock()
        self._moved = threading.Condition()
        self._subscriber: Any = None
        self._newest: tuple[ModelMessage, float]
        self._kept: deque[ModelMessage] = deque(maxlen=keep)
        if key is not None:
            # Subscribe before the first fetch: no snapshot is missed between the two.
            self._subscriber = session.declare_subscriber(key, self._on_model)
        try:
            self._take_whole(fetch(), before=0)
        except BaseException:
            self.close()
            raise
        self.memory: FloatArray = self._newest[0].memory.copy() if memory is None else self._own_memory(memory)
        self._u_before_V = math.nan
        #: What is still added to the next voltage since the memory was resynchronised, V.
        self._fade_V = 0.0
        self.last_flags = 0
        self.last_std_V = math.nan
        self.last_trajectory: Trajectory | None = None
        #: The model that gave the last answer, and the name of its stand-in if the flags mark one.
        self._answered: InverseModel | None = None
        self._stand_in = ""
        self._one = np.empty(1), np.empty(1)
        self.correcting = correcting
        #: Number of the sample that the next point is for; -1 before one was given.
        self._number = -1

    @property
    def model(self) -> InverseModel:
        """The newest snapshot."""
        return self._newest[0].model

    @property
    def snapshot_seq(self) -> int:
        """Number of the last sample that the newest state has seen."""
        return self._newest[0].snapshot_seq

    @property
    def refused(self) -> int:
        """Count of messages that could not be used."""
        return self._refused + self._heard.refused

    @property
    def kept(self) -> tuple[int, ...]:
        """`snapshot_seq` of the states that `answer` can go back to, oldest first."""
        with self._moved:
            return tuple(message.snapshot_seq for message in self._kept)

    def wait(self, seq: int, timeout_s: float) -> bool:
        """Wait until the newest state has seen sample ``seq``; False if it has not after ``timeout_s``."""
        least, timeout_s = number("seq", seq), waiting_time("timeout_s", timeout_s)
        with self._moved:
            return self._moved.wait_for(lambda: self.snapshot_seq >= least, timeout_s)

    def answer(self, query: FeedforwardQuery) -> Trajectory:
        """What the service would answer to ``query`` from this model; changes nothing here.

        From the newest kept state that has seen no sample after ``as_of`` (the oldest kept if all have). For who
        commands the voltages: with ``pending`` each answer begins at the memory that the samples have left.
        Raises InputError on a query that cannot be answered.
        """
        check_domain(query.y_um, self.limits)
        if query.pending is not None:
            check_domain(query.pending.y_um, self.limits, "pending.y_um")
        with self._moved:
            kept = tuple(self._kept)
        message = kept[-1]
        if query.as_of != NEWEST:
            message = next((old for old in reversed(kept) if old.snapshot_seq <= query.as_of), kept[0])
        model = message.model
        if query.memory is None:
            memory, points, resumes_V = begin_from(model, message.memory, query, message.snapshot_seq)
        else:
            memory, points, resumes_V = query.memory, (query.y_um, query.v_um_per_s, query.a_um_per_s2), math.nan
        if memory.size != model.memory_size:
            raise FieldError("memory", f"{memory.size} values", f"{model.memory_size} for model {self.name!r}")
        trust, stale = (message.safety.trust, False) if query.as_of != NEWEST else self._standing()
        rules = Rules(self.limits, message.safety.blend_share, trust, stale)
        safety = message.safety
        got = answer_safely(model, memory, points, query.u_before_V, rules, safety.stand_in, safety.blends, resumes_V)
        return got._replace(snapshot_seq=message.snapshot_seq, model=self.name, tracked_memory=query.memory is None)

    @property
    def age_s(self) -> float:
        """Time since the newest snapshot arrived, s."""
        return time.monotonic() - self._newest[1]

    def read(self, seq: ArrayLike, y_um: ArrayLike) -> None:
        """Take readings that the next voltages are corrected by; nothing happens where the axis has no correction.

        seq : (n,) sample numbers, rising; the points must have numbers too. y_um : (n,) readings, µm. Raises FieldError
        if the lengths differ or the numbers do not rise; then nothing changes.
        """
        if self.correcting is not None:
            self.correcting.read(seq, y_um)

    def point(self, y_um: float, v_um_per_s: float = 0.0, a_um_per_s2: float = 0.0, *, seq: int | None = None) -> float:
        """The voltage, V, for the next point. Raises InputError if it is outside the domain or no finite number.

        seq : number of its sample; None: the one after the last point.
        """
        limits = self.limits
        # The compiled functions exist for floats; another number type would be compiled anew, which takes seconds.
        if not type(y_um) is type(v_um_per_s) is type(a_um_per_s2) is float:
            y_um, v_um_per_s = number("y_um", y_um), number("v_um_per_s", v_um_per_s)
            a_um_per_s2 = number("a_um_per_s2", a_um_per_s2)
        if not (limits.y_min_um <= y_um <= limits.y_max_um and math.isfinite(v_um_per_s + a_um_per_s2 + y_um)):
            raise FieldError(
                "y_um, v_um_per_s, a_um_per_s2",
                f"{y_um:g}, {v_um_per_s:g}, {a_um_per_s2:g}",
                f"finite numbers, y_um from {limits.y_min_um:g} to {limits.y_max_um:g}",
            )
        self._number = self._number if seq is None else check_seq("seq", seq)
        message = self._newest[0]
        model, after = message.model, self.memory.copy()
        motion = y_um, v_um_per_s, a_um_per_s2
        if type(model) is ChampionInverse:
            answer = model.evaluate_point(*motion, after, self._one)
        elif type(model) is LssvmInverse and after.size == model.memory_size:
            answer = model.evaluate_point(*motion, after)
        else:
            answer = None
        if answer is None:
            u_V, std_V, inside, after = model.feedforward(*_arrays(motion), self.memory)
            answer = u_V.item(0), std_V.item(0), inside.item(0)
        u, std, within = answer
        trust, stale = self._standing()
        if not (math.isfinite(u) and (within or not message.safety.blends) and trust == 1.0):
            return float(self._safely(_arrays(motion)).u_V[0])
        if self._fade_V:
            u += self._faded(1).item()
        corrects = self.correcting is not None and self._number >= 0
        if corrects:
            u += self._corrected(model, _arrays(motion), (np.array([u]), std)).item()
        self.memory = after
        step_V = limits.slew_V_per_s * model.dt_s
        u, flags = limit_voltage(u, self._u_before_V, limits.u_min_V, limits.u_max_V, step_V)
        flags |= (0 if within else OUTSIDE_DOMAIN) | (STALE if stale else 0)
        self._u_before_V, self._answered, self._stand_in = u, model, ""
        self.last_flags, self.last_std_V = flags, std
        if corrects:
            self._applied(np.array([u]), np.array([flags]))
        self._number += self._number >= 0
        return u

    def trajectory(
        self, y_um: ArrayLike, v_um_per_s: ArrayLike | None = None, a_um_per_s2: ArrayLike | None = None,
        *, seq: int | None = None,
    ) -> tuple[FloatArray, NDArray[np.uint8]]:  # fmt: skip
        """(voltages in V, flags), each (n,), for the next n points; arguments as in ``Client.trajectory``.

        seq : number of the first one's sample; None: the one after the last point. A correction is the same for all n.
        """
        y = column("y_um", y_um)
        v, a = derivatives(y, v_um_per_s, a_um_per_s2, self._newest[0].model.dt_s)
        check_domain(y, self.limits)
        self._number = self._number if seq is None else check_seq("seq", seq)
        self.last_trajectory = got = self._safely((y, v, a))
        return got.u_V, got.flags

    def resynchronise(self, seq: ArrayLike, u_V: ArrayLike, y_um: ArrayLike) -> None:
        """Take the hysteresis memory that the service tracks, and advance it along measured samples to now.

        Removes what a disturbance, or a motion that the stage did not follow, left in :attr:`memory`. What that
        changes in the voltage fades in over some samples, so that it makes no step.

        Parameters
        ----------
        seq : (n,) sample numbers, rising, up to the sample before the next point. Begin at or before the one after
            :attr:`snapshot_seq`: two samples before it give velocity and acceleration. Over numbers that are missing
            the memory goes straight, and is wrong where the stage turned meanwhile.
        u_V, y_um : (n,) voltages that were applied, V, and readings, µm. Samples that are not finite are left out.

        Raises FieldError if the lengths differ, or the numbers are not whole or do not rise; then nothing changes.
        """
        message = self._newest[0]
        model = message.model
        numbers, u, y = sequence("seq", seq), column("u_V", u_V), column("y_um", y_um)
        if not numbers.size == u.size == y.size:
            raise FieldError("u_V, y_um", f"{u.size} and {y.size} values", f"{numbers.size}, as many as seq")
        if numbers.size > 1 and not (np.diff(numbers) > 0).all():
            raise FieldError("seq", f"{numbers[:5].tolist()} ...", "rising sample numbers")
        ok = np.isfinite(u) & np.isfinite(y)
        numbers, u, y = numbers[ok], u[ok], y[ok]
        if not numbers.size:
            return
        # Backward differences, as the service takes them.
        step_s = np.diff(numbers) * model.dt_s
        v = np.concatenate([[0.0], np.diff(y) / step_s])
        a = np.concatenate([[0.0], np.diff(v) / step_s])
        new = numbers > message.snapshot_seq
        memory = message.memory if message.snapshot_seq >= 0 else model.rest_memory(float(y[0]))
        memory = model.track(y[new], v[new], a[new], u[new], memory)
        last = _arrays((float(y[-1]), 0.0, 0.0))
        if self.correcting is not None and not math.isfinite(self._u_before_V):
            there = model.feedforward(*last, memory)
            self.correcting.begin(float(u[-1]) - there.u_V.item(0), there.std_V.item(0))
        if math.isfinite(self._u_before_V) and self.memory.size == memory.size:
            change_V = [model.feedforward(*last, m).u_V.item(0) for m in (self.memory, memory)]
            step_V = change_V[0] - change_V[1]
            self._fade_V += step_V if math.isfinite(step_V) else 0.0
        self.memory, self._u_before_V = memory.copy(), float(u[-1])

    def _own_memory(self, memory: ArrayLike) -> FloatArray:
        """(m,) the memory that a caller gives. Raises FieldError where it is none of the model's."""
        own, m = column("memory", memory, least=0), self._newest[0].model.memory_size
        if own.size != m:
            raise FieldError("memory", f"{own.size} values", f"{m} for model {self.name!r}")
        return own.copy()

    def _corrected(self, model: InverseModel, points: Motion, answer: Answer) -> FloatArray:
        """(n,) what is added to the voltages for (n,) ``points``, V."""
        assert self.correcting is not None
        trouble = self._newest[0].safety.trouble or ("stale" if self.stale else "")
        return self.correcting.voltage(self._number, model, points, self.memory, answer, trouble)

    def _applied(self, u_V: FloatArray, flags: NDArray[Any]) -> None:
        """Tell the correction the (n,) voltages, V, that came of it, and their flags."""
        assert self.correcting is not None
        self.correcting.applied(self._number, u_V)
        if flags.any():
            self.correcting.leave_out(self._number, flags)

    def _faded(self, n: int) -> FloatArray:
        """(n,) what is still added to the next n voltages after a resynchronisation, V."""
        left = self._fade_V * np.exp(-np.arange(1, n + 1) / max(FADE_S / self.model.dt_s, FADE_SAMPLES))
        self._fade_V = float(left[-1]) if abs(left[-1]) > _FADED_V else 0.0
        return left

    @property
    def source(self) -> str:
        """Name of the model that gave the last voltage: "A+B" if B was blended in; for "auto" the champion's name.

        Empty before any answer, and if no model was usable and the voltage was held.
        """
        if self.last_flags & STAND_IN:
            return self._stand_in
        answered = self._answered
        if answered is None or self.last_flags & NOT_FINITE_REPLACED:
            return ""
        own = answered.names[answered.champion] if isinstance(answered, ChampionInverse) else self.name
        return f"{own}+{self._stand_in}" if self.last_flags & BLENDED else own

    @property
    def answering(self) -> Answering:
        """Which model gave the last voltage, as far as messages tell: one that predicts better is not named in them."""
        return answering(seen_in(self.last_flags, self._answered, self._newest[0].safety.trouble))

    @property
    def stale(self) -> bool:
        """Whether snapshots are expected and no longer arrive."""
        return self._standing()[1]

    @property
    def _expected(self) -> bool:
        """Whether snapshots are expected: at least one arrived after the fetched one."""
        return self._subscriber is not None and self.received > 1

    def _standing(self) -> tuple[float, bool]:
        """(weight of the model inside its domain, `stale`)."""
        safety = self._newest[0].safety
        if not self._expected:
            return safety.trust, False
        weight, stale = trust_by_age(self.age_s, safety.stale_s, safety.last_good_s)
        return safety.trust * weight, stale

    def _safely(self, points: tuple[FloatArray, FloatArray, FloatArray]) -> Trajectory:
        """The answer that the service would give; advances the memory and the voltage before the next point."""
        message = self._newest[0]
        safety = message.safety
        rules = Rules(self.limits, safety.blend_share, *self._standing())
        got = answer_safely(message.model, self.memory, points, self._u_before_V, rules, safety.stand_in, safety.blends)
        n = got.u_V.size
        added_V = self._faded(n) if self._fade_V else np.zeros(n)
        corrects = self.correcting is not None and self._number >= 0
        if corrects:
            added_V += self._corrected(message.model, points, (got.u_V + added_V, float(got.std_V[0])))
        if added_V.any():
            inside = (got.flags & OUTSIDE_DOMAIN) == 0
            u_V, flags = guard(got.u_V + added_V, inside, message.model.dt_s, self.limits, self._u_before_V)
            got = got._replace(u_V=u_V, flags=got.flags | flags)
        if corrects:
            self._applied(got.u_V, got.flags)
        self._number += n * (self._number >= 0)
        self.memory, self._u_before_V = got.memory, float(got.u_V[-1])
        self._answered, self._stand_in = message.model, got.stand_in
        self.last_flags, self.last_std_V = int(got.flags[-1]), float(got.std_V[-1])
        return got

    def close(self) -> None:
        """Stop following; the last state can still be evaluated."""
        if self._subscriber is not None:
            self._subscriber.undeclare()
            self._subscriber = None
        self._closing.set()
        fetching = self._fetching
        if fetching is not None and fetching is not threading.current_thread():
            fetching.join(_CLOSE_S)

    def _on_model(self, sample: zenoh.Sample) -> None:
        payload, known = self._heard.take(sample), not self._heard.is_unknown
        if payload is not None:
            try:
                if payload[1:2] == bytes((DELTA,)):
                    known = self._take_change(payload)
                else:
                    self._take_whole(payload)
            except DehystError as error:
                self._refused += 1
                self.last_error = str(error)
        with self._asking:
            self._missing = not known
            if self._missing and self._fetching is None:
                self._fetching = threading.Thread(target=self._fetch_whole, name="follower-fetches", daemon=True)
                self._fetching.start()

    def _fetch_whole(self) -> None:
        """A whole model was lost, or somebody else publishes, by the same key: ask who serves now.

        Once a second at most, and until the last message is known: another one may not come for long.
        """
        while True:
            self._closing.wait(max(0.0, self._fetched_s + _FETCH_S - time.monotonic()))
            with self._asking:
                if not self._missing or self._closing.is_set():
                    self._fetching = None
                    return
                self._missing = False
            self._fetched_s = time.monotonic()
            try:
                before = self.received
                self._take_whole(self._fetch(), before)
            except DehystError as error:
                self.last_error = str(error)

    def _take_whole(self, payload: bytes, before: int | None = None) -> None:
        """Take a whole model, unless others have come since there were ``before``: the newest counts."""
        message, base = decode_model(payload), checksum(payload)
        with self._taking:
            if before in (None, self.received):
                left, self._left = self._left, None
                self._take(moved(message, left) if left is not None and left.base == base else message)
                self._whole = message, base

    def _take_change(self, payload: bytes) -> bool:
        """Take a change of the last whole model; one of another is left out, and False returned."""
        change = decode_delta(payload)
        with self._taking:
            if self._whole is None:
                self._left = change
                return True  # the first one is being fetched
            if change.base != self._whole[1]:
                self._left, self.lost = change, self.lost + 1
                return False
            self._take(moved(self._whole[0], change))
        return True

    def _take(self, message: ModelMessage) -> None:
        if message.name != self.name:
            raise FieldError("model", repr(message.name), repr(self.name))
        if math.isnan(self._dt_s):
            self._dt_s = message.model.dt_s
        if message.model.dt_s != self._dt_s:
            raise FieldError("dt_s", message.model.dt_s, f"{self._dt_s:g} s; follow anew if the service was changed")
        with self._moved:
            self._kept.append(message)
            self._newest = (message, time.monotonic())
            self.received += 1
            self._moved.notify_all()


def _arrays(motion: tuple[float, float, float]) -> tuple[FloatArray, FloatArray, FloatArray]:
    y, v, a = (np.array([value]) for value in motion)
    return y, v, a
