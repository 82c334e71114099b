"""Track of the stage: fixed-lag smoother, the last voltages and readings, frame and hysteresis memory."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated, NamedTuple

import numpy as np

from dehyst.adaptive.features import FeatureMap, advance_both
from dehyst.adaptive.inverse_model import track_memory
from dehyst.adaptive.online.dead_reckoning import Reckoning
from dehyst.adaptive.smoothing import FixedLagSmoother, SmootherState
from dehyst.adaptive.state import Entry
from dehyst.adaptive.types import BoolArray, FloatArray

Motion = tuple[float, float, float]


class Step(NamedTuple):
    """One step of the smoother: reading, µm, voltage applied from then on, V, and whether the reading is good.

    Where it is not, ``y_um`` is the reckoned place.
    """

    y_um: float
    u_V: float
    good: bool = True


class Pair(NamedTuple):
    """One smoothed instant to learn: its number, motion (µm, µm/s, µm/s²), and its voltage, V, smoothed alike.

    rates : of that voltage, V/s and V/s². applied_V : the voltages that were applied at that instant and just before
    it, V. good : whether the readings at that instant and before it are good.
    """

    now: int
    y_um: float
    v_um_per_s: float
    a_um_per_s2: float
    u_V: float
    rates: tuple[float, float]
    applied_V: tuple[float, float]
    good: bool


class Taken(NamedTuple):
    """Result of the intake of a sample: the gate that refused it or "", and the steps to make.

    jump_um : move of the frame, µm. first : whether no other unconfirmed jump is open. distrusted : whether
    the readings are on trial from now on; renamed : whether the name of the sensor fault has changed.
    """

    refused: str
    steps: tuple[Step, ...] = ()
    jump_um: float = 0.0
    distrusted: bool = False
    renamed: bool = False
    first: bool = False


@dataclass(slots=True)
class Past:
    """A known place of the stage, and the voltages since: dead reckoning can start from it.

    The first four are as ``Track.since_motion`` gives them.
    """

    motion: Annotated[Motion, Entry("motion there", "µm, µm/s, µm/s²", "3")]
    u_before_V: Annotated[float, Entry("voltage there", "V", finite=False)]
    lag_V: Annotated[FloatArray, Entry("voltages over the lag since", "V", finite=False, most=20_000)]
    lag_um: Annotated[FloatArray, Entry("first readings over the lag since", "µm", finite=False, most=20_000)]
    memory: Annotated[FloatArray, Entry("hysteresis memory there", "µm", "m")]
    u_V: Annotated[list[float], Entry("voltages since", "V", finite=False, most=5000)]

    def check_state(self) -> None:
        """Raise ValueError where there are more readings than voltages."""
        if len(self.lag_um) > len(self.lag_V):
            raise ValueError(f"lag_um: {len(self.lag_um)} readings, but {len(self.lag_V)} voltages")

    @classmethod
    def of(cls, track: Track) -> Past:
        return cls(*track.since_motion(), track.memory.copy(), [])

    @classmethod
    def reckoned(cls, reckoning: Reckoning) -> Past:
        """The place where ``reckoning`` is now."""
        place_um, u_V = np.array([reckoning.y_um]), np.array([reckoning.u_V])
        motion = (reckoning.y_um, reckoning.v_um_per_s, 0.0)
        return cls(motion, reckoning.u_V, u_V, place_um, reckoning.memory.copy(), [])


@dataclass(slots=True)
class Track:
    """A track with its state; ``base`` is the feature map of the model that the learner started from.

    ``features`` and ``served`` differ for a lag after a jump. ``frozen_memory`` knows of no jump.
    ``drive`` smooths the voltage as ``state`` does the motion: what the smoother takes from the motion is then missing
    in both, so that turns, steps and fast motion teach what slow motion does.
    """

    smoother: FixedLagSmoother
    base: FeatureMap
    state: Annotated[SmootherState, Entry("state of the smoother", name="smoother")]
    drive: Annotated[SmootherState, Entry("state of the smoother of the voltage")]
    u_V: Annotated[FloatArray, Entry("ring of voltages by the smoother's count", "V", "slots", finite=False)]
    y_um: Annotated[FloatArray, Entry("ring of readings by the smoother's count", "µm", "slots", finite=False)]
    good: Annotated[BoolArray, Entry("ring of which readings are good", "", "slots")]
    features: Annotated[FeatureMap, Entry("feature map of the instant that is being learnt")]
    served: Annotated[FeatureMap, Entry("feature map to serve with")]
    memory: Annotated[FloatArray, Entry("hysteresis memory in the learner's frame", "µm", "m")]
    frozen_memory: Annotated[FloatArray, Entry("hysteresis memory in the identified frame", "µm", "m")]
    motion: Annotated[
        Motion | None, Entry("last smoothed motion, lag samples old, if any", "µm, µm/s, µm/s²", "3|0")
    ] = None
    smooth_V: Annotated[float, Entry("smoothed voltage of that motion", "V")] = 0.0
    rates: Annotated[tuple[float, float], Entry("its rates", "V/s, V/s²", "2")] = (0.0, 0.0)
    switch: Annotated[int, Entry("the smoother's count until which the two maps differ", low=0)] = 0

    def check_state(self) -> None:
        """Raise ValueError where a map has other sizes than that of the model. Equal maps become one object."""
        for name in ("features", "served"):
            getattr(self, name).check_like(self.base)
        if self.features == self.served:
            self.features = self.served

    @classmethod
    def begin(cls, smoother: FixedLagSmoother, base: FeatureMap, served: FeatureMap, y_um: float) -> Track:
        """A stage that came to rest at ``y_um`` in one stroke."""
        slots = smoother.config.lag + 2
        rings = np.zeros(slots), np.zeros(slots), np.zeros(slots, dtype=np.bool_)
        memories = served.rest_memory(y_um), base.rest_memory(y_um)
        state, drive = smoother.initial_state(y_um), smoother.initial_state(0.0)
        return cls(smoother, base, state, drive, *rings, served, served, *memories)

    def restart(self, y_um: float) -> None:
        """Begin smoothing anew; the hysteresis memory follows to where the stage now is.

        Over the readings that were not smoothed yet too: where many samples are lost there is nothing else.
        """
        self.memory, self.frozen_memory = self.memory_now(False), self.memory_now(True)
        self.state, self.drive = self.smoother.initial_state(y_um), self.smoother.initial_state(0.0)
        self.good[:] = False
        self.features, self.motion, self.switch = self.served, None, 0

    @property
    def lag(self) -> int:
        return self.smoother.config.lag

    @property
    def predicted_um(self) -> float:
        """Where the smoother expects the next reading."""
        return self.state.x.item(0)

    @property
    def rates_now(self) -> tuple[float, float]:
        """Rates of the voltage as the smoother expects them at the next sample, V/s and V/s²."""
        _, slope, bend = self.smoother.scale.tolist()
        return self.drive.x.item(1) * slope, self.drive.x.item(2) * bend

    @property
    def last_um(self) -> float:
        """The last reading that was smoothed."""
        return self.y_um.item((self.state.count - 1) % self.y_um.shape[0])

    def copy(self) -> Track:
        """An independent copy."""
        return Track(
            self.smoother, self.base, self.state.copy(), self.drive.copy(), self.u_V.copy(), self.y_um.copy(),
            self.good.copy(), self.features, self.served, self.memory.copy(), self.frozen_memory.copy(), self.motion,
            self.smooth_V, self.rates, self.switch,
        )  # fmt: skip

    def move(self, served: FeatureMap, slope: float, shift_um: float) -> None:
        """A jump: the smoother goes on at another place, y <- slope y + shift, in a new frame."""
        self.state.move(slope, shift_um)
        self.served, self.switch = served, self.state.count + self.lag

    def enter(self, frame: FeatureMap) -> None:
        """Learn and serve in another frame from now on, where no jump is under way."""
        self.features = self.served = frame

    def to_base(self) -> None:
        """Return to the frame of ``base`` and the memory tracked in it."""
        self.enter(self.base)
        self.memory, self.switch = self.frozen_memory.copy(), 0

    def creep(self, by_um: float) -> None:
        """The frame's offset moves, µm, under a motion that stays. Nothing where the frame is about to jump."""
        if self.features is self.served:
            self.enter(replace(self.served, offset_um=self.served.offset_um + by_um))

    def advance(self, step: Step) -> tuple[Pair | None, bool]:
        """One step: the pair of ``lag`` samples ago, None before there is one; whether it is the first after a jump."""
        state, slots = self.state, self.u_V.shape[0]
        slot = state.count % slots
        self.y_um[slot], self.u_V[slot], self.good[slot] = step
        if not state.count:
            self.drive.x[0] = step.u_V
        drive = self.smoother.step(self.drive, step.u_V)
        self.motion = self.smoother.step(state, step.y_um)
        if self.motion is None or drive is None:
            return None, False
        self.smooth_V, self.rates = drive[0], drive[1:]
        switched = self.features is not self.served and state.count > self.switch
        if switched:
            self.features = self.served
        if self.features is self.base:
            # No jump yet: one call for both memories costs little more than one for the first.
            advance_both(self.motion[0], self.memory, self.frozen_memory, self.base.arrays)
        else:
            self.features.advance(self.motion[0], self.memory)
            self.base.advance(self.motion[0], self.frozen_memory)
        return self.pair(), switched

    def pair(self) -> Pair | None:
        """What the smoothed instant teaches; None before there is one."""
        if self.motion is None:
            return None
        slots = self.u_V.shape[0]
        now = self.state.count - 1 - self.lag
        at, before = now % slots, (now - 1) % slots
        # As bytes: numpy's own "all" of so few costs as much as a step of the smoother.
        good = 0 not in self.good.tobytes() or bool(self.good[at] and self.good[before])
        return Pair(now, *self.motion, self.smooth_V, self.rates, (self.u_V.item(at), self.u_V.item(before)), good)

    def remember(self, memory: FloatArray) -> None:
        """Go on with another (m,) hysteresis memory, given in the frame that is served."""
        self.memory, self.frozen_memory = memory.copy(), self.served.memory_in(self.base, memory)

    def since_motion(self) -> tuple[Motion, float, FloatArray, FloatArray]:
        """The last smoothed motion, in the frame that is served, its voltage, and (lag,) voltages and readings since.

        The readings are as they came; just after a jump, those from before it are moved to where they would be now.
        """
        assert self.motion is not None
        slots = self.u_V.shape[0]
        numbers = np.arange(self.state.count - self.lag, self.state.count)
        past = numbers % slots
        u_before_V = float(self.u_V[(self.state.count - self.lag - 1) % slots])
        f, g = self.features, self.served
        y, v, a = self.motion
        # Just after a jump the smoothed instants are still in the frame from before it.
        ratio = g.gain / f.gain
        y_um = self.y_um[past]
        if f is not g:
            early = numbers < self.switch - self.lag
            y_um[early] = g.offset_um + ratio * (y_um[early] - f.offset_um)
        motion = g.offset_um + ratio * (y - f.offset_um), ratio * v, ratio * a
        return motion, u_before_V, self.u_V[past], y_um

    def memory_now(self, frozen: bool) -> FloatArray:
        """(m,) hysteresis memory after the last step: the smoothed one, carried along the readings since.

        ``frozen`` : the one in the frame of ``base``.
        """
        end, slots = self.state.count, self.u_V.shape[0]
        past = np.arange(max(end - self.lag, 0), end)
        y_um = self.y_um[past % slots]
        if frozen:
            after = self.frozen_memory.copy()
            track_memory(y_um, after, self.base.arrays)
            return after
        after = self.memory.copy()
        # Readings from before a jump are in the frame from before it; else the two frames are one.
        jumped = int(np.searchsorted(past, self.switch - self.lag))
        track_memory(y_um[:jumped], after, self.features.arrays)
        track_memory(y_um[jumped:], after, self.served.arrays)
        return after
