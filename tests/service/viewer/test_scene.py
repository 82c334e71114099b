"""What is drawn, judged on a canvas that only remembers."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dehyst.adaptive.errors import InputError
from dehyst.adaptive.types import FloatArray
from dehyst.service.viewer import style
from dehyst.service.viewer.consumer import ReferenceRing, SampleReferenceJoin
from dehyst.service.viewer.plane import HEIGHT, WIDTH, Plane, grown, ticks
from dehyst.service.viewer.records import Diagnostics, Event, Health, IntArray, SceneConfig, Status, Tracking
from dehyst.service.viewer.rerun_sink import cut, in_order
from dehyst.service.viewer.scene import Scene

MODELS = ("lssvm_adaptive", "linear")


@dataclass
class Memory:
    """A canvas that remembers everything drawn, by path."""

    curves: dict[str, list[tuple[float, int, float]]] = field(default_factory=lambda: defaultdict(list))
    shapes: dict[str, list[tuple[float, list[FloatArray]]]] = field(default_factory=lambda: defaultdict(list))
    texts: dict[str, list[tuple[float, str, str]]] = field(default_factory=lambda: defaultdict(list))
    planes: dict[str, Plane] = field(default_factory=dict)

    def scalars(self, path: str, t_s: FloatArray, seq: IntArray, values: FloatArray) -> None:
        assert len(t_s) == len(seq) == len(values) > 0
        assert np.isfinite(values).all()
        self.curves[path] += list(zip(t_s.tolist(), seq.tolist(), values.tolist(), strict=True))

    def strips(self, path: str, t_s: float, seq: int, strips: Sequence[FloatArray], colour: Any, radius: float) -> None:
        self.shapes[path].append((t_s, list(strips)))

    def points(
        self, path: str, t_s: float, seq: int, positions: FloatArray, colour: Any, radius: float, labels: Any = None
    ) -> None:
        assert labels is None or len(labels) == len(positions)
        self.shapes[path].append((t_s, [positions]))

    def text(self, path: str, t_s: float, seq: int, text: str, level: str) -> None:
        self.texts[path].append((t_s, text, level))

    def document(self, path: str, t_s: float, seq: int, markdown: str) -> None:
        self.texts[path].append((t_s, markdown, ""))

    def values(self, path: str) -> FloatArray:
        return np.array([v for _, _, v in self.curves[path]])

    def times(self, path: str) -> FloatArray:
        return np.array([t for t, _, _ in self.curves[path]])


def tracking(model: str, error_um: float, start_s: float = 0.0, n: int = 3000, dt_s: float = 1e-3) -> Tracking:
    k = np.arange(n) + round(start_s / dt_s)
    reference_um = 40.0 + 30.0 * np.sin(2 * np.pi * k * dt_s)
    return Tracking(model, k, k * dt_s, reference_um / 11.0, reference_um - error_um, reference_um)


def drawn(records: Sequence[Any], **config: Any) -> Memory:
    memory = Memory()
    scene = Scene(memory, SceneConfig("demo/x", MODELS, **config))
    scene.take_all(records)
    memory.planes = scene._planes
    return memory


def data(plane: Plane, positions: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Positions in the box (n, 2) back to data: the inverse of `Plane.points`."""
    x = positions[:, 0] / WIDTH * (plane.x_limits[1] - plane.x_limits[0]) + plane.x_limits[0]
    return x, positions[:, 1] / -HEIGHT * (plane.y_limits[1] - plane.y_limits[0]) + plane.y_limits[0]


# -- joining -----------------------------------------------------------------------------------------------------


@given(
    st.lists(st.tuples(st.integers(0, 60), st.integers(1, 8), st.booleans()), min_size=1, max_size=40),
    st.randoms(use_true_random=False),
)
@settings(deadline=None, max_examples=60)
def test_every_sample_comes_out_once_in_order_with_its_own_reference(blocks: list[Any], rng: Any) -> None:
    ring = ReferenceRing(size=256)
    join = SampleReferenceJoin("linear", ring, patience_s=0.02)
    known: dict[int, float] = {}
    taken: list[Tracking] = []
    now = 0
    for start, length, ahead in blocks:
        seq = np.arange(start, start + length)
        if ahead:
            ring.put(seq, seq * 2.0)
            known |= {int(s): s * 2.0 for s in seq}
        n = rng.randint(1, 5)
        k = np.arange(now, now + n)
        join.put(k, k * 1e-3, k * 0.1, k * 1.0)
        now += n
        taken += [t for t in [join.take()] if t is not None]
    taken += [t for t in [join.take(everything=True)] if t is not None]
    seq = np.concatenate([t.seq for t in taken])
    assert seq.tolist() == list(range(now))
    for part in taken:
        for s, u_V, reference_um in zip(part.seq, part.u_V, part.reference_um, strict=True):
            assert u_V == pytest.approx(s * 0.1)
            assert math.isnan(reference_um) or reference_um == known[int(s)]
    # Whatever was known when its sample came is not lost.
    assert join.take(everything=True) is None


def test_a_twin_without_a_reference_takes_that_of_the_main_unit() -> None:
    main, own = ReferenceRing(), ReferenceRing()
    main.put(np.arange(4), np.array([1.0, 2.0, 3.0, 4.0]))
    own.put(np.array([2]), np.array([30.0]))
    join = SampleReferenceJoin("linear", own, fallback=main)
    k = np.arange(4)
    join.put(k, k * 1e-3, k * 0.0, k * 0.0)
    got = join.take()
    assert got is not None
    assert got.reference_um.tolist() == [1.0, 2.0, 30.0, 4.0]


def test_a_ring_never_gives_away_what_it_has_overwritten() -> None:
    ring = ReferenceRing(size=8)
    ring.put(np.arange(20), np.arange(20.0))
    assert np.isnan(ring.get(np.arange(12))).all()
    assert ring.get(np.arange(12, 20)).tolist() == list(range(12, 20))
    assert np.isnan(ring.get(np.array([-1, 28]))).all()


def test_a_stage_that_begins_anew_is_counted_and_followed() -> None:
    join = SampleReferenceJoin("linear", ReferenceRing())
    k = np.arange(100, 110)
    join.put(k, k * 1e-3, k * 0.0, k * 0.0)
    join.put(k - 100, (k - 100) * 1e-3, k * 0.0, k * 0.0)
    got = join.take(everything=True)
    assert got is not None
    assert (join.restarts, got.seq.tolist()) == (1, list(range(10)))


# -- planes ------------------------------------------------------------------------------------------------------

finite = st.floats(-1e9, 1e9, allow_subnormal=False)


@given(st.lists(finite, min_size=1, max_size=20), st.lists(finite, min_size=1, max_size=20))
@settings(deadline=None)
def test_limits_only_grow_and_hold_everything(first: list[float], then: list[float]) -> None:
    one = grown(None, np.array(first))
    assert one is not None
    two = grown(one, np.array(then))
    assert two is not None
    assert two[0] <= one[0] < one[1] <= two[1]
    assert two[0] <= min(first + then)
    assert max(first + then) <= two[1]
    assert grown(two, np.array(then)) == two
    marks = ticks(*two)
    assert 1 <= len(marks) <= 6
    room = 1e-6 * (two[1] - two[0])
    assert two[0] - room <= marks[0]
    assert marks[-1] <= two[1] + room


def test_a_plane_turns_y_over() -> None:
    plane = Plane("voltage, V", "displacement, µm", (0.0, 10.0), (-5.0, 95.0))
    box = plane.points(np.array([0.0, 10.0, np.nan, 5.0]), np.array([-5.0, 95.0, 1.0, 45.0]))
    assert box.tolist() == [[0.0, 0.0], [WIDTH, -HEIGHT], [WIDTH / 2, -HEIGHT / 2]]
    where, what = plane.labels()
    assert {"voltage, V", "displacement, µm", "0", "10", "80"} <= set(what)
    # The tick that says 80 stands where 80 µm is drawn, but for the shift of its text.
    assert where[what.index("80")][1] == pytest.approx(plane.points(np.array([0.0]), np.array([80.0]))[0, 1] - 4.0)


def test_limits_that_no_value_can_set() -> None:
    assert grown(None, np.array([np.nan, np.inf, 1e300])) is None
    same = grown(None, np.array([3.0, 3.0]))
    assert same is not None
    assert same[0] < 3.0 < same[1]


# -- scene -------------------------------------------------------------------------------------------------------


def test_errors_in_um_and_percent_of_the_range_are_those_of_the_samples() -> None:
    memory = drawn([tracking("lssvm_adaptive", 0.05), tracking("linear", -2.0)], range_um=50.0)
    assert memory.values("error_um/lssvm_adaptive") == pytest.approx(np.full(3000, 0.05))
    assert memory.values("error_um/linear") == pytest.approx(np.full(3000, -2.0))
    assert memory.values("mean_error_pct/linear") == pytest.approx(np.full(60, 4.0))
    assert memory.values("mean_error_log10_pct/lssvm_adaptive") == pytest.approx(np.full(60, -1.0))
    # The reference is drawn once, not once a unit.
    assert len(memory.curves[style.REFERENCE]) == 3000


def test_the_mean_error_is_that_of_the_last_half_second_however_the_samples_are_cut() -> None:
    rng = np.random.default_rng(3)
    whole = tracking("linear", 0.0, n=4000)
    noisy = Tracking(
        "linear", whole.seq, whole.t_s, whole.u_V, whole.y_um + rng.standard_normal(4000), whole.reference_um
    )
    at_once = drawn([noisy], range_um=60.0)
    in_pieces = drawn(list(cut(noisy, 0.13)), range_um=60.0)
    path = "mean_error_pct/linear"
    assert in_pieces.times(path) == pytest.approx(at_once.times(path))
    assert in_pieces.values(path) == pytest.approx(at_once.values(path))
    t_s = at_once.times(path)[40]
    last = (noisy.t_s > t_s - 0.5 + 1e-9) & (noisy.t_s <= t_s + 1e-9)
    expected = 100.0 * np.abs(noisy.y_um - noisy.reference_um)[last].mean() / 60.0
    assert at_once.values(path)[40] == pytest.approx(expected)


def test_without_a_range_percentages_refer_to_the_span_of_the_reference() -> None:
    memory = drawn([tracking("lssvm_adaptive", 0.6)])
    assert memory.values("mean_error_pct/lssvm_adaptive")[-1] == pytest.approx(1.0, rel=1e-6)


def test_samples_without_a_reference_are_drawn_and_have_no_error() -> None:
    bare = tracking("lssvm_adaptive", 0.0, n=100)
    bare = Tracking("lssvm_adaptive", bare.seq, bare.t_s, bare.u_V, bare.y_um, np.full(100, np.nan))
    memory = drawn([bare])
    assert len(memory.curves["displacement/lssvm_adaptive_um"]) == 100
    assert "error_um/lssvm_adaptive" not in memory.curves
    assert style.REFERENCE not in memory.curves


def test_loops_before_and_after_a_change_are_those_of_their_time() -> None:
    before = tracking("lssvm_adaptive", 0.0, n=3000)
    after = tracking("lssvm_adaptive", 5.0, start_s=3.0, n=3000)
    records = in_order([after, before, Event(3.0, 3000, "gain drops", change=True)])
    memory = drawn(records, loop_s=1.0)
    plane = memory.planes[style.LOOP_PLANE]
    assert 3.0 <= memory.shapes[style.LOOP_BEFORE][0][0] < 3.5
    # It stands still, and is drawn anew where the axes have grown.
    u_V, y_um = data(plane, memory.shapes[style.LOOP_BEFORE][-1][1][0])
    assert y_um == pytest.approx(11.0 * u_V), "nothing from after the change in it"
    assert np.ptp(y_um) > 55.0
    t_s, now = memory.shapes[style.LOOP_NOW][-1]
    u_V, y_um = data(plane, now[0])
    assert t_s > 5.5
    assert y_um == pytest.approx(11.0 * u_V - 5.0)


def test_word_of_a_change_that_comes_late_leaves_nothing_from_after_it_in_before() -> None:
    records = [
        tracking("lssvm_adaptive", 0.0, n=3000),
        tracking("lssvm_adaptive", 5.0, start_s=3.0, n=300),
        Event(3.0, 3000, "change", change=True),
        tracking("lssvm_adaptive", 5.0, start_s=3.3, n=700),
    ]
    memory = drawn(records)
    u_V, y_um = data(memory.planes[style.LOOP_PLANE], memory.shapes[style.LOOP_BEFORE][-1][1][0])
    assert len(y_um) > 100
    assert y_um == pytest.approx(11.0 * u_V)


def test_a_second_note_of_the_same_change_does_not_move_it() -> None:
    records = [
        tracking("lssvm_adaptive", 0.0, n=3000),
        Event(3.0, 3000, "change", change=True),
        tracking("lssvm_adaptive", 5.0, start_s=3.0, n=1000),
        Event(3.9, 3900, "change noticed", change=True),
        tracking("lssvm_adaptive", 5.0, start_s=4.0, n=1000),
    ]
    memory = drawn(records)
    u_V, y_um = data(memory.planes[style.LOOP_PLANE], memory.shapes[style.LOOP_BEFORE][-1][1][0])
    assert y_um == pytest.approx(11.0 * u_V), "that of before the first note"


def test_diagnostics_become_curves_rates_and_the_window() -> None:
    said = [
        Diagnostics(
            k * 0.5,
            500 * k,
            {"error_V": 0.01 * k, "gain": 0.94, "counters": {"learnt": 400 * k}, "query_us": {"p50": 150.0}},
        )
        for k in range(7)
    ]
    window = Diagnostics(3.5, 3500, {"window_y_um": [0.0, 50.0, 100.0], "window_v_um_per_s": [-100.0, 0.0, 100.0]})
    memory = drawn([*said, window])
    assert memory.values("learner/error_V") == pytest.approx(0.01 * np.arange(7))
    assert memory.values("drift/gain") == pytest.approx(np.full(7, 0.94))
    assert memory.values("latency/p50_us") == pytest.approx(np.full(7, 150.0))
    assert memory.values("counter/learnt").tolist() == [400.0 * k for k in range(7)]
    assert memory.values("rate/learnt") == pytest.approx(np.full(3, 800.0))
    ((_, (positions,)),) = memory.shapes[style.WINDOW_POINTS]
    assert positions.shape == (3, 2)
    assert np.all(np.diff(positions[:, 0]) > 0)
    assert np.all(np.diff(positions[:, 1]) < 0), "upwards on a screen whose y points down"


def test_the_band_lies_two_sigma_around_the_voltage() -> None:
    samples = tracking("lssvm_adaptive", 0.0, n=1001)
    memory = drawn(
        [samples, Diagnostics(0.25, 250, {"std_V": 0.02}), Diagnostics(0.5, 500, {"u_V": 3.0, "std_V": 0.1})]
    )
    u_V = float(samples.u_V[250])
    assert memory.values(style.BAND_HIGH) == pytest.approx([u_V + 0.04, 3.2])
    assert memory.values(style.BAND_LOW) == pytest.approx([u_V - 0.04, 2.8])
    assert memory.values(style.SIGMA) == pytest.approx([20.0, 100.0])


@pytest.mark.parametrize(
    "fields",
    [
        {"gain": "much"},
        {"gain": None, "counters": {"learnt": None}, "query_us": [1, 2]},
        {"counters": 3},
        {"window_y_um": [1.0, 2.0], "window_v_um_per_s": [1.0]},
        {"window_y_um": [[1.0], [2.0]], "window_v_um_per_s": ["a", "b"]},
        {"window_y_um": [float("nan")], "window_v_um_per_s": [float("inf")]},
        {"error_V": float("nan"), "std_V": float("inf")},
        {"gain": 10**400, "window_y_um": [10**400], "window_v_um_per_s": [1.0]},
    ],
)
def test_nonsense_in_diagnostics_draws_nothing_and_breaks_nothing(fields: dict[str, Any]) -> None:
    memory = drawn([Diagnostics(1.0, 1000, fields), tracking("linear", 1.0, n=50)])
    assert not [path for path in memory.curves if path.startswith(("drift", "learner", "rate", "latency", "voltage_s"))]
    assert style.WINDOW_POINTS not in memory.shapes
    assert len(memory.curves["error_um/linear"]) == 50


def test_events_status_and_health() -> None:
    memory = drawn(
        [
            Event(1.25, 1250, "drift: gain 0.94", "WARN"),
            Status(2.0, 2000, {"stage": "demo", "samples": {"learnt": 12, "odd|name": 0.123456789}}),
            Health(2.0, 2000, {"malformed": 3}),
        ]
    )
    assert memory.texts[style.EVENTS] == [(1.25, "1.250 s  drift: gain 0.94", "WARN")]
    assert "| samples.learnt | 12 |" in memory.texts[style.STATUS][0][1]
    assert memory.values("stream/malformed").tolist() == [3.0]


def test_a_stage_that_begins_anew_is_drawn_on() -> None:
    memory = drawn([tracking("lssvm_adaptive", 0.0, start_s=10.0), tracking("lssvm_adaptive", 0.6)], range_um=60.0)
    assert len(memory.curves[style.REFERENCE]) == 6000
    assert memory.values("mean_error_pct/lssvm_adaptive")[-1] == pytest.approx(1.0)


def test_a_leap_in_time_costs_no_more_than_its_samples() -> None:
    samples = tracking("lssvm_adaptive", 0.6, n=2000)
    leaping = np.where(samples.seq < 1000, samples.t_s, samples.t_s + 8e9)
    leap = Tracking("lssvm_adaptive", samples.seq, leaping, samples.u_V, samples.y_um, samples.reference_um)
    memory = drawn([leap], range_um=60.0)
    assert 4 <= len(memory.shapes[style.LOOP_NOW]) <= 10
    assert len(memory.curves["mean_error_pct/lssvm_adaptive"]) <= 42


def test_memory_stays_bounded() -> None:
    scene = Scene(Memory(), SceneConfig("demo/x", MODELS))
    for k in range(40):
        scene.take_all([tracking("lssvm_adaptive", 0.1, start_s=0.5 * k, n=500)])
    assert len(scene._trails["lssvm_adaptive"].rows) <= 3100


@pytest.mark.parametrize(
    ("bad", "field_name"),
    [
        ({"models": ()}, "models"),
        ({"models": ("a", "a")}, "models"),
        ({"range_um": 0.0}, "range_um"),
        ({"loop_s": float("nan")}, "loop_s"),
    ],
)
def test_a_bad_scene_is_refused_by_name(bad: dict[str, Any], field_name: str) -> None:
    with pytest.raises(InputError, match=field_name):
        SceneConfig("demo/x", **{"models": MODELS, **bad})


def test_tracking_of_unequal_lengths_is_refused_by_name() -> None:
    k = np.arange(3)
    with pytest.raises(InputError, match="y_um"):
        Tracking("linear", k, k * 1.0, k * 1.0, np.zeros(2), k * 1.0)
