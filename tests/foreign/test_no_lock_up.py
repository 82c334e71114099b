"""There is no state from which good samples do not lead back: whatever happens, in whatever order, to the real axis.

The closed loop in lockstep on foreign stages, as in a rehearsal, with one event after another of short random times.
Then sane motion, and the mean error of half a second against that of the same motion before. Measured over 293 other
sequences of one to six events on the three stages: none raised, none ended in a trouble, and no sound sensor was called
wrong. How much more than 1.1 times that of before the error was, in percent of the range:

    readings            sequences   after 2 s: below 1.1 times, 99 %, most   after 3 s: the same
    were sound always         128                  65 %, 0.030, 0.056            78 %, 0.021, 0.025
    were wrong for a while    165                  64 %, 0.19, 1.49              79 %, 0.033, 0.067

So 1.1 times alone is not kept within two seconds: where the stage itself has changed, or something wrong was learnt
before the sensor had a name, the rest is learnt in the seconds after that. 3 of the 165 had more than 0.15 % left after
two seconds, all with several faults of the sensor or messages shortly after one another; after three none had.
Three moves of the zero within a second, 12 % of the range in all, leave 0.06 more after three seconds (found later).

``DEHYST_EXAMPLES`` : sequences that are tried, 8 unless told; where it is given, one that fails is made shorter.
"""

from __future__ import annotations

import copy
import functools
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import Phase, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule

from dehyst.adaptive.online.sensor_trust import SENSOR_FAULTS
from dehyst.adaptive.types import FloatArray
from dehyst.lab.rehearsal import Change, Event, Motion, RehearsalConfig, identify
from dehyst.lab.rehearsal.disturbance import DisturbedSensor, EventScale, Message, MessageLine
from dehyst.lab.rehearsal.plant import excitation_range, go_to_lowest
from dehyst.lab.rehearsal.reference import Excursion, Reference, SmoothStep
from dehyst.service.client.client import PendingCommands
from dehyst.service.config.settings import AxisConfig
from dehyst.service.protocol.query import FeedforwardQuery
from dehyst.service.protocol.samples import MAX_SEQ, SampleBatch
from dehyst.service.server.axis_loading import load_axis
from dehyst.service.storage.model_file import Bundle, BundleMeta
from tests.foreign.plants import StageFactory, issue_plant, random_plant, with_traits

DT_S, BLOCK = 1e-3, 5
CONFIG = RehearsalConfig(identify_s=10.0, support=300)
#: Plays and a mode; the same, creeping more; Preisach's hysteresis. All at 1 kHz.
STAGES: dict[str, StageFactory] = {
    "issue": issue_plant(0),
    "plays": random_plant(12),
    "preisach": with_traits(random_plant(1), modes=((240.0, 0.03, 1.0),)),
}
#: Tones of the motion, a second long together: amplitude as a share of the range, frequency, Hz, and phase.
TONES = ((0.22, 1.0, 0.3), (0.10, 2.0, 1.1), (0.05, 4.0, 2.0), (0.02, 7.0, 0.5))
PERIOD, WINDOW = 1000, 500
#: By how much the error may be larger than before, times and as a share of the range, after two and three seconds.
FACTOR = 1.1
SOUND, WRONG = {2.0: 1.5e-3, 3.0: 1.0e-3}, {2.0: 20e-3, 3.0: 1.0e-3}
#: No event changes the stage by more than this in all.
MOST_GAIN, MOST_ZERO = 1.2, 0.1
#: The largest jump of the count leaves room for numbers after it.
JUMPS = {"1000": 1000, "100000": 100_000, "2**62": 2**62 - 2**40}
#: Sequences that are tried.
EXAMPLES = int(os.environ.get("DEHYST_EXAMPLES", "8"))


class Bench:
    """A foreign stage under the real axis, in blocks, each asked for while the one before is under way."""

    def __init__(self, factory: StageFactory) -> None:
        known = identify(factory, CONFIG)
        meta = BundleMeta(
            "stage", "x", DT_S, y_min_um=known.low_um, y_max_um=known.high_um, u_min_V=float(known.u_V.min()),
            u_max_V=float(known.u_V.max()),
        )  # fmt: skip
        config = AxisConfig("x", Path("x"), known.limits, compete=("linear",), snapshot_every=BLOCK)
        self.axis = load_axis("stage", config, bundle=Bundle(dict(known.models), meta))
        self.range_um = known.high_um - known.low_um
        self.world = EventScale(self.range_um, 0.5 * (known.low_um + known.high_um), known.rest_um)
        low_V, _ = excitation_range(factory(), CONFIG)
        self.now: dict[str, Any] = {
            "plant": factory(), "tick": 0, "number": 1, "clock_s": 0.0, "count": 1, "newest": -1, "before_V": low_V,
            "commanded": PendingCommands(), "message": None, "gain": 1.0, "zero": 0.0,
        }  # fmt: skip
        go_to_lowest(self.now["plant"], low_V)
        #: (BLOCK,) errors, shares of the range, and what was called wrong, by block since the last begin.
        self.errors: list[FloatArray] = []
        self.troubles: list[str] = []
        # It settles in what is to come; then every run begins from here.
        self.run(8.0)
        self.before = np.concatenate(self.errors)[-2 * PERIOD :].reshape(2, PERIOD).mean(axis=0)
        self.saved = self.axis.state_dict(), copy.deepcopy(self.now)

    def begin(self) -> None:
        """Go back to the settled loop."""
        state, now = self.saved
        self.axis.restore(state)
        self.axis.take_events()
        self.now, self.errors, self.troubles = copy.deepcopy(now), [], []

    def __call__(self, t_s: FloatArray) -> Motion:
        """From the rest within a second to the tones about the middle of the range."""
        omega, phase = (2.0 * np.pi * TONES_HZ), PHASES
        angle = np.multiply.outer(t_s, omega) + phase
        size_um = self.range_um * AMPLITUDES
        y, v, a = np.sin(angle) @ size_um, np.cos(angle) @ (size_um * omega), -np.sin(angle) @ (size_um * omega**2)
        s, ds, dds = SmoothStep(0.0, 1.0)(t_s)
        way_um = self.world.middle_um - self.world.rest_um + y
        return Motion(self.world.rest_um + s * way_um, ds * way_um + s * v, dds * way_um + 2.0 * ds * v + s * a)

    @property
    def time_s(self) -> float:
        """Of the next sample, from the start of the loop."""
        return float(self.now["tick"] * DT_S)

    def run(self, seconds: float, event: Event | None = None, reference: Reference | None = None) -> None:
        """Go on for a while, in whole blocks. The voltages are looked at as they are commanded."""
        now, axis, limits = self.now, self.axis, self.axis.limits
        blocks = max(1, round(seconds / DT_S / BLOCK))
        event = event or Event("none", "none", max(2.0, self.time_s))
        sensor = DisturbedSensor(event, self.world, DT_S, now["tick"] + blocks * BLOCK)
        line = MessageLine(event, DT_S, now["number"])
        step_V = limits.slew_V_per_s * DT_S * (1.0 + 1e-9)
        for _ in range(blocks):
            first = now["tick"]
            y_um, v, a = (reference or self)((first + np.arange(BLOCK)) * DT_S)
            y_um = np.clip(y_um, limits.y_min_um, limits.y_max_um)
            axis.update_age(max(0, first - BLOCK - 1 - now["newest"]) * DT_S)
            begin = first + now["count"]
            pending = now["commanded"].before(begin)
            reply = axis.answer(FeedforwardQuery(y_um, v, a, u_before_V=now["before_V"], pending=pending))
            assert np.isfinite(reply.u_V).all()
            assert limits.u_min_V <= reply.u_V.min() <= reply.u_V.max() <= limits.u_max_V
            assert np.abs(np.diff(reply.u_V, prepend=now["before_V"])).max() <= step_V
            now["commanded"].take(begin, y_um, reply)
            now["before_V"] = float(reply.u_V[-1])
            self._hear(now["message"], first)
            true_um, read_um = now["plant"].run(reply.u_V)
            now["message"] = line.carry(first, reply.u_V, sensor.read(first, read_um))
            now["tick"] += BLOCK
            self.errors.append(np.abs(true_um - y_um) / self.range_um)
            self.troubles.append(axis.newest.trouble)

    def _hear(self, message: Message | None, first: int) -> None:
        """The samples of the block before come while this one, from ``first`` on, is asked for."""
        if message is None:
            return
        batch, tick = message.batch, message.tick
        # The stage's clock goes on whatever its count does.
        self.axis.handle(SampleBatch(batch.seq, (tick + 1) * DT_S + self.now["clock_s"], batch.u_V, batch.y_um))
        self.now["newest"] = first - 1
        self.now["count"] = sorted((batch.seq - tick).tolist())[tick.size // 2]

    # ---- what happens

    def happens(self, kind: str, seconds: float, size: float = 0.0, seed: int = 0) -> None:
        """Something wrong with the readings or the messages, for a while; the size in the unit of its kind."""
        self.run(seconds, Event(kind, kind, self.time_s, size, seconds, seed))

    def changes(self, kind: str, seconds: float, size: float, over_s: float = 0.0) -> None:
        """Something physical, a gain or a zero within what a stage may come to in all."""
        now = self.now
        if kind == "gain":
            if not 1.0 / MOST_GAIN <= now["gain"] * (1.0 + size) <= MOST_GAIN:
                size = 1.0 / now["gain"] - 1.0
            now["gain"] *= 1.0 + size
        elif kind == "zero":
            size = -now["zero"] if abs(now["zero"] + size) > MOST_ZERO else size
            now["zero"] += size
        assert now["plant"].change(Change(kind, size if kind == "gain" else size * self.range_um, over_s))
        self.run(seconds)

    def jumps(self, seconds: float, by: int) -> None:
        """The count goes on from elsewhere; from its beginning where there is no room."""
        room = self.now["number"] + by + self.now["tick"] + 2**30 < MAX_SEQ
        self.now["number"] = self.now["number"] + by // 1000 * 1000 if room else 1
        self.run(seconds)

    def rails(self, up: bool) -> None:
        """The reference asks for more than the stage reaches, for 0.3 s."""
        limits, at_s = self.axis.limits, self.time_s
        level_um = limits.y_max_um if up else limits.y_min_um
        self.run(0.5, reference=Excursion(self, level_um, at_s, at_s + 0.5, 0.1))

    # ---- what has come of it

    def comes_back(self, within: dict[float, float]) -> None:
        """Sane motion leads back to the error of before, but for so much after so long, to no trouble, to learning."""
        begin_s = self.time_s
        for seconds, more in within.items():
            self.run(begin_s + seconds - WINDOW * DT_S - self.time_s)
            learnt = self.axis.gates["learnt"]
            self.run(WINDOW * DT_S)
            error = np.concatenate(self.errors[-WINDOW // BLOCK :]).mean()
            ticks = np.arange(self.now["tick"] - WINDOW, self.now["tick"])
            before = self.before[ticks % PERIOD].mean()
            assert error <= FACTOR * before + more, (
                f"after {seconds} s: {100 * error:.3f} %, before {100 * before:.3f} %"
            )
            assert self.troubles[-1] == ""
            assert self.axis.newest.trust == 1.0
            # A step of the filter every other sample.
            assert self.axis.gates["learnt"] - learnt > 0.4 * WINDOW


AMPLITUDES, TONES_HZ, PHASES = (np.array(column) for column in zip(*TONES, strict=True))


@functools.cache
def bench(name: str) -> Bench:
    """One axis for each stage: its states are restored, it is not made anew."""
    return Bench(STAGES[name])


#: How long something lasts, s.
seconds = st.floats(0.02, 0.5)
seeds = st.integers(0, 1000)
signs = st.sampled_from([-1.0, 1.0])


class Anything(RuleBasedStateMachine):
    """All that can happen to an axis, in any order; at its end sane motion leads back."""

    @initialize(name=st.sampled_from(sorted(STAGES)))
    def begins(self, name: str) -> None:
        self.bench = bench(name)
        self.bench.begin()
        self.sound = True

    @rule(seconds=seconds)
    def nothing(self, seconds: float) -> None:
        self.bench.run(seconds)

    @rule(seconds=seconds, share=st.floats(0.01, 0.05))
    def knock(self, seconds: float, share: float) -> None:
        self.bench.changes("knock", seconds, share)

    @rule(seconds=seconds, share=st.floats(0.03, 0.12), sign=signs, over_s=st.sampled_from([0.0, 0.2]))
    def gain(self, seconds: float, share: float, sign: float, over_s: float) -> None:
        self.bench.changes("gain", seconds, sign * share, over_s)

    @rule(seconds=seconds, share=st.floats(0.01, 0.08), sign=signs, over_s=st.sampled_from([0.0, 0.2]))
    def zero(self, seconds: float, share: float, sign: float, over_s: float) -> None:
        self.bench.changes("zero", seconds, sign * share, over_s)

    @rule(seconds=seconds, share=st.floats(5e-4, 0.01), seed=seeds)
    def hum(self, seconds: float, share: float, seed: int) -> None:
        self.bench.happens("hum", seconds, share, seed)

    @rule(seconds=seconds, kind=st.sampled_from(["spikes", "bursts"]), share=st.floats(0.005, 1.0), seed=seeds)
    def glitches(self, seconds: float, kind: str, share: float, seed: int) -> None:
        self.bench.happens(kind, seconds, share, seed)

    @rule(seconds=seconds, kind=st.sampled_from(["losses", "duplicates"]), share=st.floats(0.3, 0.95), seed=seeds)
    def messages(self, seconds: float, kind: str, share: float, seed: int) -> None:
        self.bench.happens(kind, seconds, share, seed)

    @rule(seconds=seconds, kind=st.sampled_from(["gap", "reversed"]))
    def order(self, seconds: float, kind: str) -> None:
        self.bench.happens(kind, seconds)

    @rule(seconds=seconds, by=st.sampled_from(sorted(JUMPS.values())))
    def number_jump(self, seconds: float, by: int) -> None:
        self.bench.jumps(seconds, by)

    @rule(seconds=seconds, by=st.sampled_from([1000, 100_000, 2**62]))
    def number_stray(self, seconds: float, by: int) -> None:
        self.bench.happens("number_stray", seconds, float(by))

    @rule(seconds=seconds, by_s=st.floats(0.01, 1e6), sign=signs)
    def clock(self, seconds: float, by_s: float, sign: float) -> None:
        self.bench.now["clock_s"] += sign * by_s
        self.bench.run(seconds)

    @rule(up=st.booleans())
    def rail(self, up: bool) -> None:
        self.bench.rails(up)

    @rule(seconds=seconds, share=st.sampled_from([0.0, 1e-9, 1e-6, 3e-5]), seed=seeds)
    def stuck(self, seconds: float, share: float, seed: int) -> None:
        self.sound = False
        self.bench.happens("stuck_noise" if share else "stuck", seconds, share, seed)

    @rule(seconds=seconds, factor=st.one_of(st.floats(0.01, 0.5), st.floats(1.6, 3.0)))
    def sensor_gain(self, seconds: float, factor: float) -> None:
        self.sound = False
        self.bench.happens("sensor_gain", seconds, factor)

    @rule(seconds=seconds, kind=st.sampled_from(["sign", "foreign"]), seed=seeds)
    def other_readings(self, seconds: float, kind: str, seed: int) -> None:
        self.sound = False
        self.bench.happens(kind, seconds, 0.0, seed)

    @invariant()
    def a_sound_sensor_is_not_called_wrong(self) -> None:
        if self.sound:
            assert not SENSOR_FAULTS & set(self.bench.troubles)

    def teardown(self) -> None:
        if hasattr(self, "sound"):
            self.bench.comes_back(SOUND if self.sound else WRONG)


TestAnything = pytest.mark.timeout(180 + 10 * EXAMPLES)(Anything.TestCase)
# To make a sequence that fails shorter takes many times as long as to find it: only where it was asked for.
TestAnything.settings = settings(
    max_examples=EXAMPLES,
    stateful_step_count=7,
    deadline=None,
    phases=[Phase.generate, Phase.shrink] if "DEHYST_EXAMPLES" in os.environ else [Phase.generate],
)

EVENTS: dict[str, Callable[[Bench], None]] = {
    "knock": lambda b: b.changes("knock", 0.3, 0.05),
    "gain_at_once": lambda b: b.changes("gain", 0.3, -0.12),
    "zero_at_once": lambda b: b.changes("zero", 0.3, 0.08),
    "hum": lambda b: b.happens("hum", 0.5, 0.01, 3),
    "spikes": lambda b: b.happens("spikes", 0.5, 1.0, 3),
    "bursts": lambda b: b.happens("bursts", 0.5, 1.0, 4),
    "gap": lambda b: b.happens("gap", 0.5),
    "losses": lambda b: b.happens("losses", 0.5, 0.95),
    "duplicates": lambda b: b.happens("duplicates", 0.5, 1.0),
    "reversed": lambda b: b.happens("reversed", 0.5),
    **{f"number_jump_{name}": functools.partial(Bench.jumps, seconds=0.3, by=by) for name, by in JUMPS.items()},
    "number_stray_2**62": lambda b: b.happens("number_stray", 0.3, 2.0**62),
    "clock": lambda b: b.now.update(clock_s=-1e6),
    "rail": lambda b: b.rails(True),
    "stuck": lambda b: b.happens("stuck", 0.5),
    "stuck_noise": lambda b: b.happens("stuck_noise", 2.0, 1e-9),
    "sensor_gain": lambda b: b.happens("sensor_gain", 2.0, 0.01),
    "sign": lambda b: b.happens("sign", 2.0, 0.0, 1),
    "foreign": lambda b: b.happens("foreign", 2.0, 0.0, 2),
}


@pytest.mark.parametrize("event", EVENTS)
def test_two_seconds_of_motion_lead_back_from_each_alone(event: str) -> None:
    alone = bench("issue")
    alone.begin()
    EVENTS[event](alone)
    alone.comes_back({2.0: SOUND[2.0]})


def test_without_any_event_the_error_stays_as_it_was() -> None:
    for name in STAGES:
        quiet = bench(name)
        quiet.begin()
        quiet.run(1.0)
        quiet.comes_back({2.0: SOUND[2.0]})
        assert set(quiet.troubles) == {""}
        assert np.concatenate(quiet.errors).mean() <= 1.02 * quiet.before.mean()
        assert quiet.before.mean() < 5e-4
