"""When the faults of a plan really come: each with its time to recover, whatever those before it took."""

from __future__ import annotations

from hypothesis import given, settings
from hypothesis import strategies as st

from dehyst.lab.soak.fault_plan import FAULT_KINDS, LATE_S, PlannedFault, Schedule, SoakPlan, make_plan


def plan_of(*faults: PlannedFault, duration_s: float = 60.0) -> SoakPlan:
    return SoakPlan(duration_s, 1, faults, ())


GAP, NAN = PlannedFault("gap", 6.0, 1.0), PlannedFault("nan", 20.0, 1.0)


def test_a_fault_comes_when_it_is_planned() -> None:
    schedule = Schedule(plan_of(GAP, NAN), lambda _: True)
    assert schedule.due(5.99) is None
    assert schedule.due(6.0) == GAP
    # A tick later than planned is no delay.
    schedule.over(GAP, 7.0 + LATE_S)
    assert schedule.due(19.99) is None
    assert schedule.due(20.0) == NAN
    assert schedule.due(59.0) is None
    assert schedule.left_out() == []


def test_those_behind_one_that_took_longer_come_as_much_later() -> None:
    schedule = Schedule(plan_of(GAP, NAN), lambda _: True)
    assert schedule.due(6.0) == GAP
    schedule.over(GAP, 17.0)
    assert schedule.due(29.99) is None
    assert schedule.due(30.0) == NAN


def test_one_that_may_not_happen_yet_waits_and_so_do_those_behind_it() -> None:
    allowed = False
    schedule = Schedule(plan_of(GAP, NAN), lambda _: allowed)
    assert schedule.due(6.0) is None
    assert schedule.due(9.0) is None
    allowed = True
    assert schedule.due(9.5) == GAP
    schedule.over(GAP, 10.5)
    assert schedule.due(22.5) is None
    assert schedule.due(23.1) == NAN


def test_what_has_no_time_left_to_recover_is_left_out_and_said() -> None:
    last = PlannedFault("restart_stage", 45.0, 1.0)
    schedule = Schedule(plan_of(GAP, last, NAN), lambda _: True)
    assert schedule.due(6.0) == GAP
    schedule.over(GAP, 12.0)
    assert schedule.due(50.0) == NAN, "a shorter one may fit"
    assert schedule.left_out() == ["restart_stage at 45 s: left out, no time to recover"]
    waiting = Schedule(plan_of(GAP, NAN), lambda _: False)
    assert waiting.due(6.0) is None
    assert waiting.left_out() == [
        "gap at 6 s: left out, it did not come to it", "nan at 20 s: left out, it did not come to it"
    ]  # fmt: skip


@given(seed=st.integers(0, 2**31), starts_s=st.lists(st.floats(0.0, 20.0), min_size=30, max_size=30))
@settings(max_examples=40, deadline=None)
def test_however_long_a_machine_takes_to_begin_them_each_has_its_time(seed: int, starts_s: list[float]) -> None:
    """Once a fault began when the run was as good as over, and that nobody had told of it was held against the rest."""
    plan = make_plan(200.0, seed, tuple(FAULT_KINDS))
    schedule = Schedule(plan, lambda _: True)
    now_s, well_s, began = 0.0, 0.0, []
    while now_s < plan.duration_s:
        due = schedule.due(now_s)
        if due is None:
            now_s += 0.02
            continue
        fault = due
        assert now_s >= well_s - LATE_S
        start_s = starts_s[len(began) % len(starts_s)]
        began.append(fault)
        assert now_s + fault.duration_s + FAULT_KINDS[fault.kind].recover_s <= plan.duration_s + LATE_S
        now_s += start_s + fault.duration_s
        schedule.over(fault, now_s)
        well_s = now_s + FAULT_KINDS[fault.kind].recover_s
    assert began == sorted(began, key=lambda fault: fault.at_s)
    assert len(began) + len(schedule.left_out()) == len(plan.faults)
