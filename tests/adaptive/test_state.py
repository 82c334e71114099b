"""The declared state: what is saved loads to the same, and what is not as declared is refused by name."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field, replace
from typing import Annotated, Any, NamedTuple

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dehyst.adaptive.errors import InputError, ModelFileError
from dehyst.adaptive.state import MOST_FLOAT, MOST_INT, Entry, Kinded, Numbers, load, record_of, restore, rows, save
from dehyst.adaptive.types import BoolArray, FloatArray, IntArray, StateDict

SIZES = {"p": 3}


class Mark(NamedTuple):
    beta: Annotated[FloatArray, Entry("estimate", "V", "p")]
    at: Annotated[int, Entry("when", low=0)]


@dataclass(slots=True)
class Held:
    u_V: Annotated[list[float], Entry("voltages", "V", "held", finite=False, most=50)]
    y_um: Annotated[list[float], Entry("readings", "µm", "held", finite=False, most=50)]
    fault: Annotated[str, Entry("name of the fault", among=("", "stuck"))] = ""


@dataclass(frozen=True)
class Frame(Kinded):
    KIND = "frame"

    gain: Annotated[float, Entry("gain", low=0.0)]
    places: Annotated[tuple[int, ...], Entry("places", shape="*", low=0, most=20)] = ()

    def __post_init__(self) -> None:
        if not self.gain > 0.0:
            raise InputError(f"gain: got {self.gain}, expected a positive number")


@dataclass(slots=True)
class Whole:
    seq: Annotated[int, Entry("number of the last sample", low=-1)]
    t_s: Annotated[float, Entry("its time", "s", finite=False)]
    valid: Annotated[bool, Entry("whether it is valid")]
    why: Annotated[str, Entry("the reason", most=40)]
    P: Annotated[FloatArray, Entry("covariance", "V²", "p,p|0,0")]
    order: Annotated[IntArray, Entry("slots", shape="p", low=0, high=2)]
    good: Annotated[BoolArray, Entry("which are good", shape="p")]
    counts: Annotated[dict[str, int], Entry("outcomes", low=0, among=("learnt", "refused"))]
    motion: Annotated[tuple[float, float, float], Entry("motion", "µm", "3")]
    hold: Annotated[Held | None, Entry("held readings")]
    frame: Annotated[Frame, Entry("the frame", name="")]
    mark: Annotated[Mark, Entry("a mark")]
    base: object = None

    def check_state(self) -> None:
        if sorted(self.order.tolist()) != list(range(self.order.size)):
            raise ValueError("order: no permutation")


doubles = st.floats(-MOST_FLOAT, MOST_FLOAT)


@st.composite
def wholes(draw: st.DrawFn) -> Whole:
    def array(*shape: int) -> FloatArray:
        size = math.prod(shape)
        return np.array(draw(st.lists(doubles, min_size=size, max_size=size)), dtype=np.float64).reshape(shape)

    n = draw(st.integers(0, 4))
    held = Held(
        array(n).tolist(), [draw(doubles | st.just(math.nan)) for _ in range(n)], draw(st.sampled_from(["", "stuck"]))
    )
    return Whole(
        draw(st.integers(-1, MOST_INT)), draw(st.floats()),
        draw(st.booleans()), draw(st.text(max_size=40)), draw(st.sampled_from([array(3, 3), np.empty((0, 0))])),
        np.array(draw(st.permutations(range(3)))), np.array(draw(st.lists(st.booleans(), min_size=3, max_size=3))),
        {"learnt": draw(st.integers(0, 9)), "refused": 0}, draw(st.tuples(doubles, doubles, doubles)),
        draw(st.sampled_from([None, held])), Frame(draw(st.floats(1e-9, 1e9)), tuple(range(n))),
        Mark(array(3), draw(st.integers(0, MOST_INT))),
    )  # fmt: skip


def same(a: StateDict, b: StateDict) -> bool:
    return a.keys() == b.keys() and all(
        type(a[name]) is type(b[name])
        and np.array_equal(a[name], b[name], equal_nan=np.asarray(a[name]).dtype == float)
        for name in a
    )


@settings(max_examples=60, deadline=None)
@given(wholes())
def test_what_is_saved_loads_to_the_same_and_shares_nothing(whole: Whole) -> None:
    state = save(whole)
    again = load(Whole, state, SIZES, {"base": "given"})
    assert same(save(again), state)
    assert again.base == "given"
    before = save(whole)
    again.P[:], again.order[:] = 7.0, 0
    again.counts["learnt"] += 1
    again.mark.beta[:] = 1.0
    if again.hold is not None:
        again.hold.u_V.append(1.0)
    assert same(save(whole), before)


WRONG: list[Any] = [
    None, True, -1, 0, 5, 2**62, 2**63, 10**400, 0.5, -1e308, math.nan, math.inf, "", "stuck", "x" * 50, [], [1], {},
    np.array(np.nan), np.array(1), np.zeros(0), np.zeros(3), np.zeros(3, np.int64), np.zeros(3, np.bool_), np.zeros(4),
    np.zeros((3, 3)), np.zeros((0, 0)), np.zeros((2, 3)), np.full((3, 3), np.nan), np.full(3, 1e300), np.arange(3),
    np.zeros(60), np.zeros(3, np.float32), np.array(["x"]), np.array([None]), np.full(3, -1),
]  # fmt: skip


@settings(max_examples=400, deadline=None)
@given(wholes(), st.data())
def test_every_entry_that_is_changed_is_refused_by_name_or_loads_to_a_valid_record(
    whole: Whole, data: st.DataObject
) -> None:
    state = save(whole)
    name = data.draw(st.sampled_from([*sorted(state), "extra", "hold.extra", "mark.extra"]))
    if data.draw(st.booleans()) or name not in state:
        changed = state | {name: data.draw(st.sampled_from(WRONG))}
    else:
        changed = {key: value for key, value in state.items() if key != name}
    said, made = "", None
    try:
        made = load(Whole, changed, SIZES)
    except ModelFileError as error:
        said = str(error)
    if made is None:
        assert name.split(".")[0] in said
        assert "start from the model file" in said
    else:
        again = save(made)
        assert same(save(load(Whole, again, SIZES)), again)
        assert made.P.shape in ((3, 3), (0, 0))
        assert np.isfinite(made.P).all()
        assert made.hold is None or len(made.hold.u_V) == len(made.hold.y_um) <= 50


WHOLE = Whole(
    0, 0.0, True, "", np.eye(3), np.arange(3), np.ones(3, bool), {"learnt": 0, "refused": 0}, (0.0, 0.0, 0.0),
    Held([1.0], [math.nan]), Frame(1.0), Mark(np.zeros(3), 0),
)  # fmt: skip


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"P": np.zeros((2, 2))}, r"entry P: got float64 \(2, 2\), expected an array of float64, a shape of \(3, 3\)"),
        ({"order": np.zeros(3, np.int64)}, "order: no permutation"),
        ({"order": np.full(3, 9)}, "order: got elements from 9 to 9, expected finite numbers from 0 to 2"),
        ({"seq": -2}, "seq: got -2, expected a number from -1"),
        ({"seq": 2**70}, "seq: got .* expected an integer from -3 x 2.61"),
        ({"gain": math.inf}, "gain: got inf, expected a finite number"),
        ({"gain": 0.0}, "gain: got 0.0, expected a positive number"),
        ({"kind": "map"}, "kind: got 'map', expected 'frame'"),
        ({"hold.fault": "drunk"}, "hold.fault: got 'drunk', expected .*stuck"),
        ({"hold.y_um": np.zeros(2)}, r"hold.y_um: got float64 \(2,\), expected .* a shape of \(1,\)"),
        ({"hold.u_V": np.zeros(51), "hold.y_um": np.zeros(51)}, "hold.u_V"),
        ({"counts.lost": 1}, "counts.lost: got 1, expected no entry of this name"),
        ({"mark.beta": np.full(3, np.nan)}, "mark.beta: got elements from nan to nan, expected finite numbers"),
        ({"why": "x" * 41}, "why: got 41 characters, expected at most 40"),
        ({"seq.more": 1}, "seq: got entries , more, expected one entry"),
    ],
)
def test_a_refusal_says_what_is_expected(changes: StateDict, words: str) -> None:
    with pytest.raises(ModelFileError, match=words):
        load(Whole, save(WHOLE) | changes, SIZES)


class Part:
    """An object that is filled in place."""

    count: Annotated[int, Entry("steps", low=0)]
    _last: Annotated[deque[float], Entry("last values", "V", most=9)]
    mark: Annotated[Mark, Entry("a mark")]

    def __init__(self) -> None:
        self.count, self._last, self.mark = 0, deque(maxlen=2), Mark(np.zeros(3), 0)


class Owner:
    inner: Annotated[Part, Entry("an inner part")]
    flat: Annotated[Part, Entry("another, among the entries of its owner", name="")]

    def __init__(self) -> None:
        self.inner, self.flat = Part(), Part()


def test_an_object_is_filled_in_place_or_stays_as_it_is() -> None:
    one, two = Owner(), Owner()
    one.inner.count, one.flat.count, one.flat.mark = 4, 5, Mark(np.ones(3), 9)
    one.inner._last.extend(float(k) for k in range(5))
    state, inner = save(one), two.inner
    assert set(state) == {
        f"{part}{name}" for part in ("", "inner.") for name in ("count", "last", "mark.beta", "mark.at")
    }
    restore(two, state, SIZES)
    assert two.inner is inner
    assert same(save(two), state)
    assert two.inner._last.maxlen == 2
    for name in state:
        with pytest.raises(ModelFileError, match=name.split(".")[0]):
            restore(two, state | {"count": 8, name: "no"}, SIZES)
        assert same(save(two), state)


@dataclass(slots=True)
class Few:
    x: Annotated[FloatArray, Entry("a vector", "V", "p", low=-1.0, high=1.0)] = field(
        default_factory=lambda: np.ones(3)
    )
    n: Annotated[int, Entry("a count", low=0)] = 0


def test_the_page_lists_every_entry_that_is_saved() -> None:
    assert list(rows(Few)) == [("x", "a vector [(p), V, from -1 to 1]"), ("n", "a count [from 0]")]
    listed = {row.name for row in rows(Whole)}
    assert {*save(replace(WHOLE, counts={"NAME": 0}))} - {"gain", "kind", "places"} <= listed


# ---- numbers that compiled code shares


class Inner(Numbers):
    at: Annotated[float, Entry("where", "µm", finite=False)] = math.nan
    count: Annotated[int, Entry("how many", low=0)] = 3


class Outer(Numbers):
    inner: Annotated[Inner, Entry("a record")]
    fine: Annotated[bool, Entry("whether all is well")]
    _hold: Annotated[Held | None, Entry("held readings")]
    x: Annotated[FloatArray, Entry("a vector", "V", "p")]

    def __init__(self) -> None:
        self.record, self.x = np.zeros((), record_of(Outer)), np.zeros(3)
        self.inner = Inner()


def test_numbers_are_those_of_their_record() -> None:
    outer = Outer()
    assert record_of(Outer).names == ("inner", "fine", "hold")
    assert (outer.inner.count, outer.fine, outer._hold) == (3, False, None)
    outer.inner.count += 4
    outer.record["fine"], outer.record["inner"]["at"] = True, 2.5
    outer._hold = Held([1.0], [2.0])
    assert (outer.inner, outer.fine) == (Inner(2.5, 7), True)
    assert (outer.record["inner"]["count"], outer.record["hold"]) == (7, True)
    # Compiled code ends what is there at times.
    outer.record["hold"] = False
    assert outer._hold is None
    with pytest.raises(TypeError, match="got at, count, more, expected at, count"):
        Inner(more=1)


def test_a_part_is_filled_in_place_and_as_a_whole_or_not_at_all() -> None:
    outer, other = Outer(), Outer()
    other.inner, other.fine, other._hold, other.x[:] = Inner(1.0, 2), True, Held([1.0], [2.0], "stuck"), 5.0
    record, x, inner = outer.record, outer.x, outer.inner
    with pytest.raises(ModelFileError, match=r"inner\.count"):
        restore(outer, save(other) | {"inner.count": -1}, SIZES)
    assert (inner.count, x.tolist()) == (3, [0.0] * 3)
    restore(outer, save(other), SIZES)
    assert record is outer.record
    assert x is outer.x
    assert (inner, record["fine"].item(), x.tolist()) == (Inner(1.0, 2), True, [5.0] * 3)
    assert outer._hold == other._hold
    assert same(save(outer), save(other))
