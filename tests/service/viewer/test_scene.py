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
from dehyst.service.protocol.samples import SampleBatch
from dehyst.service.viewer import style
from dehyst.service.viewer.computed_run import cut, in_order
from dehyst.service.viewer.consumer import ReferenceRing, Unit
from dehyst.service.viewer.plane import HEIGHT, WIDTH, Plane
from dehyst.service.viewer.records import Diagnostics, Event, IntArray, SceneConfig, Tracking
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
    unit = Unit("linear", ring)
    known: dict[int, float] = {}
    surely: set[int] = set()
    taken: list[Tracking] = []
    now = 0
    for start, length, ahead in blocks:
        seq = np.arange(start, start + length)
        if ahead:
            ring.put(seq, seq * 2.0)
            known |= {int(s): s * 2.0 for s in seq}
        n = rng.randint(1, 5)
        k = np.arange(now, now + n)
        unit.put(SampleBatch(k, k * 1e-3, k * 0.1, k * 1.0))
        surely |= known.keys() & {*k.tolist()}
        now += n
        taken += [t for t in [unit.take()] if t is not None]
    taken += [t for t in [unit.take(everything=True)] if t is not None]
    seq = np.concatenate([t.seq for t in taken])
    assert seq.tolist() == list(range(now))
    for part in taken:
        for s, u_V, reference_um in zip(part.seq, part.u_V, part.reference_um, strict=True):
            assert u_V == pytest.approx(s * 0.1)
            assert int(s) not in surely or not math.isnan(reference_um)
            assert math.isnan(reference_um) or reference_um == known[int(s)]
    assert unit.take(everything=True) is None


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
