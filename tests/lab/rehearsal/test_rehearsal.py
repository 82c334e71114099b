"""The rehearsal: what it takes for a plant, what it asks, what it does to a stage, and what it makes of a run."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest

from dehyst.adaptive.errors import InputError
from dehyst.lab.rehearsal import EVENT_KINDS, SENSOR, Event, RehearsalConfig, factory_of, rehearse
from dehyst.lab.rehearsal.disturbance import MESSAGE, DisturbedPlant, DisturbedSensor, EventScale, MessageLine
from dehyst.lab.rehearsal.outcome import outcome
from dehyst.lab.rehearsal.plant import FunctionPlant, Plant, run_checked
from dehyst.lab.rehearsal.reference import Excursion, RandomReference, ReferenceRequest
from dehyst.lab.rehearsal.rehearsal import remarks, table
from dehyst.lab.rehearsal.runs import LoopRecord
from dehyst.service.answers.guard import Limits
from dehyst.service.protocol.samples import MAX_SEQ
from tests.foreign.plants import issue_plant, random_plant

WORLD = EventScale(range_um=100.0, middle_um=50.0, rest_um=0.0)
SHORT = RehearsalConfig(identify_s=10.0, settle_s=2.0, after_s=4.0, support=200)
DT_S = 1e-3


class Line2:
    """A plant of a line: 1 µm for each V, a sample late, which takes no event."""

    dt_s, u_min_V, u_max_V = DT_S, 0.0, 100.0

    def __init__(self) -> None:
        self.last_V = 0.0

    def run(self, u_V: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        y_um = np.concatenate([[self.last_V], u_V[:-1]])
        self.last_V = float(u_V[-1])
        return y_um, y_um + 0.0


def line(u_V: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return u_V, u_V


# What may be a plant.


def test_a_plant_a_class_a_function_and_what_makes_one_are_taken() -> None:
    for given in (Line2, Line2(), lambda: Line2()):
        one, other = factory_of(given)(), factory_of(given)()
        assert isinstance(one, Plant)
        assert one is not other
    made = factory_of(line, 1e-3, 0.0, 10.0)()
    assert isinstance(made, FunctionPlant)
    assert (made.dt_s, made.u_min_V, made.u_max_V) == (1e-3, 0.0, 10.0)


@pytest.mark.parametrize(
    ("given", "numbers", "words"),
    [
        (line, (), "plant.dt_s: got nothing"),
        (line, (1e-3, 0.0), "plant.u_max_V: got nothing"),
        (line, (1e-3, 5.0, 5.0), "more than u_min_V"),
        (line, (float("nan"), 0.0, 5.0), "finite"),
        (line, (10.0, 0.0, 5.0), "1e-5 to 0.1 s"),
        (42, (1e-3, 0.0, 5.0), "an object with run"),
    ],
)
def test_what_is_no_plant_is_refused_by_name(given: object, numbers: tuple[float, ...], words: str) -> None:
    with pytest.raises(InputError, match=words):
        factory_of(given, *numbers)


@pytest.mark.parametrize(
    ("answer", "words"),
    [
        (lambda u: u, "two arrays"),
        (lambda u: (u, u[:-1]), r"read_um: got shape \(4,\), expected shape \(5,\)"),
        (lambda u: (u, "no"), "numbers"),
        (lambda u: u["no"], "plant: run: got IndexError.*test_rehearsal.py line"),
        (lambda u: (np.where(u > 2.0, np.nan, u), u), r"true_um\[3\]: got nan µm at 3 V"),
    ],
)
def test_what_a_plant_answers_is_looked_at(answer: Any, words: str) -> None:
    with pytest.raises(InputError, match=words):
        run_checked(FunctionPlant(answer, 1e-3, 0.0, 10.0), np.arange(5.0))


# What is asked.


@pytest.mark.parametrize("seed", range(3))
def test_the_reference_belongs_together_and_keeps_to_its_band(seed: int) -> None:
    wish = ReferenceRequest(start_um=0.0, low_um=10.0, high_um=90.0, duration_s=8.0, seed=seed)
    t_s = np.arange(80_000) * 1e-4
    y, v, a = RandomReference(wish)(t_s)
    assert (y[0], v[0], a[0]) == (0.0, 0.0, 0.0)
    assert y.min() > -0.1
    assert y[t_s > 2.0].min() > 10.0 - 1e-9
    assert y.max() < 90.0 + 1e-9
    assert np.abs(np.gradient(y, 1e-4) - v)[2:-2].max() < 1e-4 * np.abs(v).max()
    assert np.abs(np.gradient(v, 1e-4) - a)[2:-2].max() < 1e-3 * np.abs(a).max()
    # Acceleration is smooth: no jump from one sample to the next.
    assert np.abs(np.diff(a)).max() < 0.02 * np.abs(a).max()
    assert np.ptp(y) > 20.0
    assert np.array_equal(RandomReference(wish)(t_s[:100])[0], y[:100])


def test_an_excursion_goes_there_and_comes_back_smoothly() -> None:
    wish = ReferenceRequest(0.0, 10.0, 90.0, 8.0, 1)
    base = RandomReference(wish)
    t_s = np.arange(8000) * 1e-3
    y, v, _ = Excursion(base, 105.0, 3.0, 4.0)(t_s)
    assert np.allclose(y[(t_s > 3.31) & (t_s < 3.69)], 105.0)
    outside = (t_s < 3.0) | (t_s > 4.0)
    assert np.array_equal(y[outside], base(t_s)[0][outside])
    assert np.abs(np.gradient(y, 1e-3) - v)[2:-2].max() < 1e-2 * np.abs(v).max()


# What happens.


def stood(event: Event, u_V: np.ndarray, block: int = 7) -> np.ndarray:
    stand = DisturbedPlant(Line2(), event, WORLD)
    return np.concatenate([stand.run(k, u_V[k : k + block])[0] for k in range(0, u_V.size, block)])


def test_physics_are_emulated_where_the_plant_takes_none() -> None:
    u_V = np.full(4000, 40.0)
    assert stood(Event("g", "gain", 2.0, 0.05), u_V)[[1999, 2000]] == pytest.approx([40.0, 42.0])
    zero = stood(Event("z", "zero", 2.0, -0.1, over_s=0.2), u_V)
    assert zero[[1999, 2100, 3999]] == pytest.approx([40.0, 35.0, 30.0])
    knock = stood(Event("k", "knock", 2.0, 0.02, seed=3), u_V) - 40.0
    assert not knock[2:2000].any()
    assert 0.5 < np.abs(knock[2000:]).max() <= 2.0
    assert np.abs(knock[-100:]).max() < 1e-2
    steps = np.where(np.arange(4000) < 3000, 40.0, 50.0)
    lag = stood(Event("l", "lag", 2.0, 0.01), steps)
    assert lag[3011] == pytest.approx(50.0 - 10.0 * np.exp(-1.1), abs=0.1)
    stand = DisturbedPlant(Line2(), Event("p", "payload", 2.0, 1.0), WORLD)
    stand.run(0, u_V)
    assert "payload" in stand.left_out


def test_a_plant_takes_its_own_events_at_the_sample() -> None:
    factory = issue_plant(2)
    changed, plain = (
        DisturbedPlant(factory(), Event("z", "zero", 2.0, 0.1), WORLD),
        DisturbedPlant(factory(), Event("n", "none", 2.0), WORLD),
    )
    u_V = np.full(2500, 4.0)
    after = [np.concatenate([stand.run(k, u_V[k : k + 5])[0] for k in range(0, 2500, 5)]) for stand in (changed, plain)]
    assert np.array_equal(after[0][:2001], after[1][:2001])
    assert after[0][-1] - after[1][-1] == pytest.approx(10.0, abs=0.2)


@pytest.mark.parametrize(
    ("kind", "size", "expected"),
    [
        ("stuck", 0.0, lambda y: np.full(y.size, y[0])),
        ("sensor_gain", 0.5, lambda y: 0.5 * y),
        ("sign", 0.0, None),
        ("stuck_noise", 1e-6, lambda y: np.full(y.size, y[0])),
        ("hum", 0.01, lambda y: y),
    ],
)
def test_a_sensor_is_wrong_while_it_lasts_and_not_longer(kind: str, size: float, expected: Any) -> None:
    event = Event(kind, kind, 2.0, size, over_s=1.0, seed=4)
    sensor = DisturbedSensor(event, WORLD, DT_S, 4000)
    y = 50.0 + 30.0 * np.sin(np.arange(4000) * 0.01)
    read = np.concatenate([sensor.read(k, y[k : k + 5]) for k in range(0, 4000, 5)])
    inside = slice(2000, 3000)
    assert np.array_equal(np.delete(read, np.arange(2000, 3000)), np.delete(y, np.arange(2000, 3000)))
    if expected is None:
        assert np.ptp(read[inside] + y[inside]) < 1e-9
    else:
        assert np.abs(read[inside] - expected(y[inside])).max() <= (1.0 if kind == "hum" else 1e-3)


def carried(kind: str, size: float, over_s: float = 0.0, first: int = 2000) -> Any:
    event = Event(kind, kind, 2.0, size, over_s, seed=2)
    values = np.arange(float(first), first + 5.0)
    return MessageLine(event, DT_S, first_number=11).carry(first, values, values)


def test_columns_are_mixed_up_while_it_lasts_and_not_longer() -> None:
    """Voltage 1, 2, 3 ... and reading ten times that; an event of 5 samples from the second message on."""
    expected = {
        "units": lambda k: (1e3 * k, 1e4 * k),
        "exchanged": lambda k: (10.0 * k, 1.0 * k),
        "u_sign": lambda k: (-1.0 * k, 10.0 * k),
        "u_constant": lambda k: (np.full(5, 6.0), 10.0 * k),
        "u_late": lambda k: (k - 2.0, 10.0 * k),
        "u_scaled": lambda k: (0.002 * k, 10.0 * k),
        "other_stage": lambda k: (k - 2.0, 10.0 * k - 20.0),
    }
    assert set(expected) == {name for name, kind in EVENT_KINDS.items() if kind[:2] == (SENSOR, MESSAGE)}
    for kind, shown in expected.items():
        line = MessageLine(Event(kind, kind, 2.0, 0.002, 0.005), DT_S, first_number=11)
        for first, values in ((1995, np.arange(1.0, 6.0)), (2000, np.arange(6.0, 11.0)), (2005, np.arange(11.0, 16.0))):
            message = line.carry(first, values, 10.0 * values)
            assert message is not None
            u_V, y_um = shown(values) if first == 2000 else (values, 10.0 * values)
            assert message.batch.u_V == pytest.approx(u_V), kind
            assert message.batch.y_um == pytest.approx(y_um), kind


def test_messages_are_lost_doubled_turned_round_and_misnumbered() -> None:
    whole = carried("none", 0.0)
    assert whole.batch.seq.tolist() == [2011, 2012, 2013, 2014, 2015]
    assert np.allclose(whole.batch.t_s, np.arange(2011, 2016) * DT_S)
    assert carried("gap", 0.0, 1.0) is None
    assert carried("losses", 1.0, 1.0) is None
    doubled = carried("duplicates", 1.0, 1.0)
    assert doubled.batch.seq.tolist() == [s for s in range(2011, 2016) for _ in range(2)]
    assert doubled.tick.tolist() == [s for s in range(2000, 2005) for _ in range(2)]
    turned = carried("reversed", 0.0, 1.0)
    assert turned.batch.y_um.tolist() == [2004.0, 2003.0, 2002.0, 2001.0, 2000.0]
    assert carried("number_jump", 100_000.0).batch.seq.tolist() == list(range(102_011, 102_016))
    assert carried("number_jump", float(2**62 - 2**40)).batch.seq.max() < MAX_SEQ
    stray = carried("number_stray", float(2**62))
    assert stray.batch.seq.tolist() == [MAX_SEQ, 2012, 2013, 2014, 2015]
    assert stray.batch.seq.dtype == np.int64
    assert np.allclose(carried("clock", -5.0).batch.t_s, np.arange(2011, 2016) * DT_S - 5.0)
    assert carried("clock", -5.0, first=0).batch.t_s[0] == pytest.approx(0.011)


# What comes of it.


def course(error_um: np.ndarray, u_V: np.ndarray, trouble: np.ndarray | None = None) -> LoopRecord:
    n = error_um.size
    t_s = np.arange(n) * DT_S
    wanted_um = 50.0 + 50.0 * np.sin(2.0 * np.pi * t_s)
    zero = np.zeros(n, dtype=np.int16)
    said = zero if trouble is None else trouble.astype(np.int16)
    true_um = wanted_um - error_um
    return LoopRecord(
        t_s,
        wanted_um,
        true_um,
        true_um,
        u_V,
        zero.astype(np.uint8),
        zero,
        ("learnt",),
        said,
        ("", "sensor_frozen"),
        np.zeros(n, dtype=np.int64),
    )


def test_figures_are_of_the_parts_that_they_are_named_after() -> None:
    limits = Limits(0.0, 10.0, 1e4)
    n, quiet = 9000, 5.0 + 4.0 * np.sin(2.0 * np.pi * DT_S * np.arange(9000))
    error = np.zeros(n)
    error[2000:4000] = -0.1
    error[4000:5000], error[5000:8000], error[8000:] = -6.0, -2.0, -0.2
    u_V = quiet.copy()
    u_V[4100:4300] = 10.0  # at the limit, and by 6 µm of 100 further up than wanted
    u_V[8000:] = 10.0  # at the limit, but where it is wanted
    event = Event("gain_at_once", "gain", 4.0, 0.06)
    result = outcome(event, course(error, u_V), course(0.5 * error, quiet), None, 100.0, limits, DT_S, "")
    one = result.adaptive
    assert (one.before_pct, one.first_second_pct, one.then_pct) == pytest.approx((0.1, 6.0, 2.0))
    assert (one.settled_pct, one.worst_half_second_pct) == pytest.approx((1.1, 6.0))
    assert (one.large_s, one.large_at_s) == pytest.approx((1.0, 0.0))
    assert not one.ends_at_rail
    assert result.worst_ratio == pytest.approx(2.0)
    error[8000:] = 20.0  # at the limit, and still not there: no voltage does better
    result = outcome(event, course(error, u_V), course(error, quiet), None, 100.0, limits, DT_S, "")
    assert not result.adaptive.ends_at_rail
    assert result.adaptive.large_s == pytest.approx(1.0)
    error[8000:] = -20.0
    result = outcome(event, course(error, u_V), course(error, quiet), None, 100.0, limits, DT_S, "")
    assert result.adaptive.ends_at_rail
    assert "ENDS AT A RAIL" in remarks(result)
    assert json.loads(json.dumps(result.as_dict(), allow_nan=False))["event"]["kind"] == "gain"


def test_trouble_is_timed_by_motion_and_false_where_nothing_happened() -> None:
    limits, n = Limits(0.0, 10.0, 1e4), 9000
    said = np.zeros(n)
    said[3000:3100] = 1
    said[4250:6000] = 1
    calm, u_V = np.zeros(n), np.full(n, 5.0)
    wrong = calm.copy()
    wrong[4000:6000] = 3.0
    event = Event("sign", "sign", 4.0, over_s=2.0)
    result = outcome(
        event, course(wrong, u_V, said), course(calm + 1.0, u_V), course(calm + 0.8, u_V), 100.0, limits, DT_S, ""
    )
    assert [(t.name, t.named_s, t.until_s) for t in result.troubles] == [
        ("sensor_frozen", pytest.approx(-1.0), pytest.approx(-0.9)),
        ("sensor_frozen", pytest.approx(0.25), pytest.approx(2.0)),
    ]
    # The reference stands still for a moment at each of its ends.
    assert 0.2 < result.named_s <= 0.25
    assert result.false_troubles == ("sensor_frozen",)
    # The better one, off by 0.8 %, is the last estimate: 1.2 % are allowed.
    assert (result.sensor_ratio, result.sensor_excess) == pytest.approx((3.75, 2.5))
    assert result.healthy_s == 4.0
    nothing = outcome(
        Event("none", "none", 4.0), course(calm, u_V, said), course(calm, u_V), None, 100.0, limits, DT_S, ""
    )
    assert nothing.false_troubles == ("sensor_frozen", "sensor_frozen")
    assert np.isnan(nothing.named_s)


def test_a_whole_rehearsal_learns_is_repeatable_and_tells_both_models_apart() -> None:
    events = [
        Event("none", "none", 3.0), Event("gain_fast", "gain", 3.0, 0.06, over_s=0.2),
        Event("sign", "sign", 3.0, over_s=0.5),
    ]  # fmt: skip
    factory = random_plant(3)
    done = rehearse(factory, config=SHORT, events=events, seed=1)
    again = rehearse(factory, config=SHORT, events=events[:1], seed=1)
    assert np.array_equal(done.runs[0].adaptive.u_V, again.runs[0].adaptive.u_V)
    quiet, gained, flipped = (run.outcome for run in done.runs)
    last = done.runs[2].last
    assert last is not None
    # The same run until the fault; then what was learnt before it, without what was learnt from it.
    assert np.array_equal(last.true_um[:3000], done.runs[2].adaptive.true_um[:3000])
    assert not np.array_equal(last.true_um[3000:3500], done.runs[2].adaptive.true_um[3000:3500])
    during = [
        float(np.abs(course.wanted_um - course.true_um)[3000:3500].mean()) for course in (done.runs[2].frozen, last)
    ]
    assert during[1] < 0.8 * during[0]
    assert flipped.sensor_ratio == pytest.approx(
        flipped.adaptive.during_pct / (100.0 * during[1] / done.runs[2].range_um), rel=1e-6
    )
    assert done.runs[1].last is None
    assert np.isnan(gained.sensor_ratio)
    assert quiet.adaptive.settled_pct < 0.2
    assert gained.adaptive.settled_pct < 0.3 < gained.frozen.settled_pct
    for run in done.runs:
        n = run.adaptive.t_s.size
        assert all(values.size == n for values in (run.adaptive.u_V, run.adaptive.verdict, run.frozen.true_um))
        assert n % SHORT.block == 0
        assert "learnt" in run.adaptive.verdicts
    # Until the event both runs are one.
    at = round(3.0 / done.identified.dt_s)
    assert np.array_equal(done.runs[0].adaptive.true_um[:at], done.runs[1].adaptive.true_um[:at])
    assert json.dumps(done.as_dict(), allow_nan=False)
    assert "the stage's gain changes by +6 %" in table(done)
    assert table(done, markdown=True).count("\n") == 4
