"""The model followed into the caller's process: fast, and with no wire between the question and the answer."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import zenoh
from numpy.typing import ArrayLike, NDArray

from adaptive.errors import DehystError
from adaptive.inverse_model import LssvmInverse
from adaptive.types import FloatArray, InverseModel
from baselines.competition.champion import ChampionInverse
from service.answers.answering import trust_by_age
from service.answers.fallback import Answer, Rules, answer_safely
from service.answers.guard import Limits, check_domain
from service.answers.motion import derivatives
from service.protocol.errors import FieldError
from service.protocol.model import ModelMessage, decode_model
from service.protocol.reply import (
    BLENDED,
    LIMITED_SLEW,
    LIMITED_VOLTAGE,
    NOT_FINITE_REPLACED,
    OUTSIDE_DOMAIN,
    STALE,
    STAND_IN,
)


class Follower:
    """Holds the newest snapshot of one model and the caller's hysteresis memory, and evaluates here.

    Every answer advances :attr:`memory`, so that points asked one after the other are one trajectory. The limits of
    the service are enforced here as there. One thread asks; snapshots arrive in another.

    Attributes
    ----------
    memory : (m,) hysteresis memory after the last point answered.
    received, refused : snapshots taken over, and those that could not be used.
    last_flags : what was done to the last voltage answered, bits as in a reply (``service.protocol.reply.flag_names``).
    last_std_V : one standard deviation of it, V; NaN where the model has no notion of it, and before any answer.
    last_trajectory : all that :meth:`trajectory` last answered, deviations and stand-in among it; None before any.
    """

    def __init__(
        self,
        session: zenoh.Session,
        key: str | None,
        name: str,
        fetch: Callable[[], bytes],
        limits: Limits,
        memory: ArrayLike | None = None,
    ) -> None:
        self.limits = limits
        self.name = name
        self.received = 0
        self.refused = 0
        self.last_error = ""
        self._lock = threading.Lock()
        self._subscriber: Any = None
        self._newest: tuple[ModelMessage, float]
        if key is not None:
            # Subscribed before the first fetch, so that no snapshot falls between the two.
            self._subscriber = session.declare_subscriber(key, self._on_model)
        try:
            self._take(decode_model(fetch()))
        except BaseException:
            self.close()
            raise
        self.memory: FloatArray = (
            self._newest[0].memory.copy() if memory is None else np.array(memory, dtype=np.float64).reshape(-1)
        )
        self._u_before_V = math.nan
        self.last_flags = 0
        self.last_std_V = math.nan
        self.last_trajectory: Answer | None = None
        #: Who gave the last answer: the model itself, and the name of what stood in for it where the flags say so.
        self._answered: InverseModel | None = None
        self._stand_in = ""
        self._one = np.empty(1), np.empty(1)

    @property
    def model(self) -> InverseModel:
        """The newest snapshot."""
        return self._newest[0].model

    @property
    def snapshot_seq(self) -> int:
        """The last sample that the newest snapshot had seen."""
        return self._newest[0].snapshot_seq

    @property
    def age_s(self) -> float:
        """Time since the newest snapshot arrived, s."""
        return time.monotonic() - self._newest[1]

    def point(self, y_um: float, v_um_per_s: float = 0.0, a_um_per_s2: float = 0.0) -> float:
        """The voltage, V, for the next point. Raises InputError beyond the domain or on what is not finite."""
        limits = self.limits
        if not (limits.y_min_um <= y_um <= limits.y_max_um and math.isfinite(v_um_per_s + a_um_per_s2 + y_um)):
            raise FieldError(
                "y_um, v_um_per_s, a_um_per_s2",
                f"{y_um:g}, {v_um_per_s:g}, {a_um_per_s2:g}",
                f"finite numbers, y_um from {limits.y_min_um:g} to {limits.y_max_um:g}",
            )
        message = self._newest[0]
        model, after = message.model, self.memory.copy()
        # Compiled for floats: another kind of number would be compiled for, which takes seconds.
        motion = float(y_um), float(v_um_per_s), float(a_um_per_s2)
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
        # The guard of one point without its arrays: the same order, the same numbers, the same flags.
        self.memory = after
        flags = (0 if within else OUTSIDE_DOMAIN) | (STALE if stale else 0)
        if u < limits.u_min_V:
            u = limits.u_min_V
            flags |= LIMITED_VOLTAGE
        elif u > limits.u_max_V:
            u = limits.u_max_V
            flags |= LIMITED_VOLTAGE
        before = self._u_before_V
        if math.isfinite(before):
            step = limits.slew_V_per_s * model.dt_s
            if u > before + step:
                u = before + step
                flags |= LIMITED_SLEW
            elif u < before - step:
                u = before - step
                flags |= LIMITED_SLEW
        self._u_before_V, self._answered, self._stand_in = u, model, ""
        self.last_flags, self.last_std_V = flags, std
        return u

    def trajectory(
        self, y_um: ArrayLike, v_um_per_s: ArrayLike | None = None, a_um_per_s2: ArrayLike | None = None
    ) -> tuple[FloatArray, NDArray[np.uint8]]:
        """(voltages in V, flags), each (n,), for the next n points; arguments as in ``Client.trajectory``."""
        y = np.atleast_1d(np.asarray(y_um, dtype=np.float64))
        model = self._newest[0].model
        v, a = derivatives(y, v_um_per_s, a_um_per_s2, model.dt_s)
        for field, values in (("y_um", y), ("v_um_per_s", v), ("a_um_per_s2", a)):
            if not np.isfinite(values).all():
                raise FieldError(field, "NaN or infinity", "finite numbers")
        check_domain(y, self.limits)
        self.last_trajectory = got = self._safely((y, v, a))
        return got.u_V, got.flags

    @property
    def source(self) -> str:
        """Which model gave the last voltage: a competition's champion, "A+B" where B was blended in, a stand-in alone.

        Empty before any, and where nobody could say anything and the voltage before was held.
        """
        if self.last_flags & STAND_IN:
            return self._stand_in
        answered = self._answered
        if answered is None or self.last_flags & NOT_FINITE_REPLACED:
            return ""
        own = answered.names[answered.champion] if isinstance(answered, ChampionInverse) else self.name
        return f"{own}+{self._stand_in}" if self.last_flags & BLENDED else own

    @property
    def stale(self) -> bool:
        """Whether snapshots have stopped coming."""
        return self._standing()[1]

    @property
    def _expected(self) -> bool:
        """Whether snapshots come: some did, after the first one was fetched."""
        return self._subscriber is not None and self.received > 1

    def _standing(self) -> tuple[float, bool]:
        """(weight of the model inside its domain, whether snapshots have stopped coming)."""
        safety = self._newest[0].safety
        if not self._expected:
            return safety.trust, False
        weight, stale = trust_by_age(self.age_s, safety.stale_s, safety.last_good_s)
        return safety.trust * weight, stale

    def _safely(self, points: tuple[FloatArray, FloatArray, FloatArray]) -> Answer:
        """What the service would answer; advances memory and the voltage from which the slew limit counts."""
        message = self._newest[0]
        safety = message.safety
        rules = Rules(self.limits, safety.blend_share, *self._standing())
        got = answer_safely(message.model, self.memory, points, self._u_before_V, rules, safety.stand_in, safety.blends)
        self.memory, self._u_before_V = got.memory, float(got.u_V[-1])
        self._answered, self._stand_in = message.model, got.stand_in
        self.last_flags, self.last_std_V = int(got.flags[-1]), float(got.std_V[-1])
        return got

    def close(self) -> None:
        """Stop to follow; what was received last can still be evaluated."""
        if self._subscriber is not None:
            self._subscriber.undeclare()
            self._subscriber = None

    def _on_model(self, sample: zenoh.Sample) -> None:
        try:
            self._take(decode_model(sample.payload.to_bytes()))
        except DehystError as error:
            # The last good snapshot stays; the count and the words are there for whoever looks.
            self.refused += 1
            self.last_error = str(error)

    def _take(self, message: ModelMessage) -> None:
        if message.name != self.name:
            raise FieldError("model", repr(message.name), repr(self.name))
        with self._lock:
            self._newest = (message, time.monotonic())
            self.received += 1


def _arrays(motion: tuple[float, float, float]) -> tuple[FloatArray, FloatArray, FloatArray]:
    y, v, a = (np.array([value]) for value in motion)
    return y, v, a
