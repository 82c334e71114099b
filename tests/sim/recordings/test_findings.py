"""What is wrong with a recording is found, placed and counted; a healthy one is left in peace; repairs are exact."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dehyst.adaptive.errors import InputError
from dehyst.sim.recordings import Recording, check, repaired, require_usable
from dehyst.sim.recordings.findings import LARGEST_LEAD, lead
from tests.hidden.foreign.cases import pair
from tests.hidden.foreign.score import recording_of

DT = 0.001


def healthy(n: int = 4000, seed: int = 3) -> Recording:
    """A lagging, noisy stage under a sine with a hold in its middle."""
    rng = np.random.default_rng(seed)
    t_s = np.arange(n) * DT
    phase = 2 * np.pi * 3.0 * t_s
    u_V = 4.0 - 3.5 * np.cos(phase)
    y_um = 40.0 - 36.0 * np.cos(phase - 0.15) + 0.01 * rng.standard_normal(n)
    hold = slice(2 * n // 5, n // 2)
    u_V[hold], y_um[hold] = u_V[hold.start], y_um[hold.start] + 0.01 * rng.standard_normal(n // 2 - 2 * n // 5)
    return Recording(t_s=t_s, u_V=u_V, y_um=y_um, dt_s=DT, source="made")


def kinds(recording: Recording) -> dict[str, str]:
    return {finding.kind: finding.severity for finding in check(recording)}


def without(recording: Recording, gone: np.ndarray) -> Recording:
    keep = np.ones(len(recording), dtype=bool)
    keep[gone] = False
    return replace(recording, t_s=recording.t_s[keep], u_V=recording.u_V[keep], y_um=recording.y_um[keep])


def changed(recording: Recording, **columns: tuple[object, object]) -> Recording:
    copies = {}
    for name, (where, value) in columns.items():
        copies[name] = getattr(recording, name).copy()
        copies[name][where] = value
    return replace(recording, **copies)


def test_a_healthy_recording_has_no_findings() -> None:
    for seed in range(5):
        assert check(healthy(seed=seed)) == []
    whole = repaired(healthy())
    assert whole.done == ()
    assert whole.valid.all()
    np.testing.assert_array_equal(whole.recording.y_um, healthy().y_um)


def test_gaps() -> None:
    recording = without(healthy(), np.r_[500:510, 900])
    (finding,) = check(recording)
    assert (finding.kind, finding.count, finding.severity) == ("gap", 2, "warning")
    assert finding.at_s == pytest.approx((0.499, 0.899))
    assert "11 samples missing" in finding.message
    whole = repaired(recording)
    assert np.flatnonzero(~whole.valid).tolist() == [*range(500, 510), 900]
    np.testing.assert_allclose(whole.recording.t_s, healthy().t_s, atol=1e-12)
    np.testing.assert_array_equal(whole.recording.y_um[whole.valid], recording.y_um)


def test_a_long_gap_or_a_step_back_splits_and_the_longest_part_is_taken() -> None:
    whole = repaired(without(healthy(), np.r_[1000:1100]))
    assert len(whole.recording) == 2900
    assert whole.recording.t_s[0] == pytest.approx(1.1)
    twice = healthy(1500), healthy(2500)
    joined = replace(
        twice[0],
        **{name: np.concatenate([getattr(r, name) for r in twice]) for name in ("t_s", "u_V", "y_um")},
    )
    assert kinds(joined)["backwards"] == "warning"
    assert len(repaired(joined).recording) == 2500


def test_doubled_samples_by_time_and_by_value() -> None:
    base = healthy()
    again = np.sort(np.r_[np.arange(4000), 700, 1300])
    by_time = replace(base, t_s=base.t_s[again], u_V=base.u_V[again], y_um=base.y_um[again])
    assert kinds(by_time) == {"doubled": "warning"}
    np.testing.assert_array_equal(repaired(by_time).recording.y_um, base.y_um)
    by_value = changed(base, u_V=(700, base.u_V[699]), y_um=(700, base.y_um[699]))
    assert [(f.kind, f.count, f.at_s) for f in check(by_value)] == [("doubled", 1, (pytest.approx(0.7),))]
    whole = repaired(by_value)
    assert np.flatnonzero(~whole.valid).tolist() == [700]
    assert whole.recording.u_V[700] == pytest.approx(base.u_V[700], abs=1e-3)


def test_dropouts_to_zero() -> None:
    base = healthy()
    broken = changed(base, y_um=(np.r_[800:803, 2500], 0.0))
    (finding,) = check(broken)
    assert (finding.kind, finding.column, finding.count) == ("dropout", "y_um", 4)
    whole = repaired(broken)
    np.testing.assert_allclose(whole.recording.y_um[[800, 801, 802, 2500]], base.y_um[[800, 801, 802, 2500]], atol=0.3)
    # A sensor that merely passes through zero is no dropout.
    through = replace(base, y_um=np.round(base.y_um - 40.0, 1))
    assert np.count_nonzero(through.y_um == 0.0) > 0
    assert "dropout" not in kinds(through)


def test_flat_tops() -> None:
    base = healthy()
    clipped = replace(base, y_um=np.minimum(base.y_um, 70.0))
    assert kinds(clipped) == {"clipped": "warning"}
    # However much of it is lost.
    half = replace(base, y_um=np.minimum(base.y_um, float(np.median(base.y_um))))
    assert kinds(half) == {"clipped": "warning"}
    # A coarse reading that moves in steps, and a stage that rests at its highest place, are not clipped.
    coarse = replace(base, y_um=np.round(base.y_um / 10.0) * 10.0)
    assert "clipped" not in kinds(coarse)
    # A slow turn of a sensor of finite resolution: ten equal readings at the top, and five to ten at other turns.
    t_s = 5e-5 * np.arange(40_000)
    y_um = 45.0 + 30.0 * np.sin(2 * np.pi * t_s) + 10.0 * np.sin(10 * np.pi * t_s)
    y_um += 1e-3 * np.random.default_rng(2).standard_normal(t_s.size)
    turning = Recording(t_s, (y_um - 5.0) / 10.0, np.round(y_um / 0.01) * 0.01, 5e-5)
    assert "clipped" not in kinds(turning)
    assert kinds(replace(turning, y_um=np.minimum(turning.y_um, 80.0))).get("clipped") == "warning"
    rests = base.t_s > 0.5 * base.t_s[-1]
    resting = replace(
        base, u_V=np.where(rests, base.u_V.max(), base.u_V), y_um=np.where(rests, base.y_um.max(), base.y_um)
    )
    assert kinds(resting).get("clipped") != "warning"
    limited = replace(base, u_V=np.minimum(base.u_V, 7.0))
    assert kinds(limited) == {"clipped": "note"}


def test_not_finite() -> None:
    few = changed(healthy(), y_um=(np.r_[100:110], np.nan), u_V=(5, np.inf))
    found = {finding.column: finding.count for finding in check(few)}
    assert found == {"y_um": 10, "u_V": 1}
    whole = repaired(few)
    assert np.isfinite(whole.recording.y_um).all()
    assert (~whole.valid).sum() == 11
    ridden = changed(healthy(), y_um=(np.random.default_rng(1).permutation(4000)[:1500], np.nan))
    with pytest.raises(InputError, match=r"made: y_um: 1500 of 4000 samples"):
        require_usable(ridden, check(ridden))


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("column", ["t_s", "u_V", "y_um", "monitor_V"])
@pytest.mark.parametrize("values", [np.nan, np.inf, 1e300, 1e-310])
def test_columns_beyond_arithmetic_give_findings_and_no_warnings(column: str, values: float) -> None:
    base = replace(healthy(), monitor_V=healthy().u_V)
    with np.errstate(invalid="ignore"):
        whole = getattr(base, column) * values
    found = check(replace(base, **{column: whole}))
    assert {finding.column for finding in found} & {column, ""}
    check(replace(base, **{column: np.where(np.arange(len(base)) % 5 == 0, whole, getattr(base, column))}))


@pytest.mark.parametrize("column", ["u_V", "y_um"])
@pytest.mark.parametrize("level", [0.0, 2.5])
def test_all_zero_and_constant_are_refused(column: str, level: float) -> None:
    dead = changed(healthy(), **{column: (slice(None), level)})
    with pytest.raises(InputError, match=f"{column}: every sample is"):
        require_usable(dead, check(dead))


def test_swapped_columns_are_refused_and_right_ones_are_not() -> None:
    base = healthy()
    exchanged = replace(base, u_V=base.y_um, y_um=base.u_V)
    with pytest.raises(InputError, match="look swapped"):
        require_usable(exchanged, check(exchanged))
    negative = replace(base, y_um=-base.y_um)
    assert "swapped" not in kinds(negative)


def test_a_displacement_that_is_a_line_of_the_voltage_is_refused() -> None:
    base = healthy()
    coarse = np.round(base.u_V / 0.003) * 0.003
    for u_V, y_um in ((base.u_V, 9.0 * base.u_V + 4.0), (coarse, np.round(-8.0 * base.u_V, 4))):
        target = replace(base, u_V=u_V, y_um=y_um)
        with pytest.raises(InputError, match=r"y_um: a straight line of u_V.*a target, or a copy.*--column y="):
            require_usable(target, check(target))
    counts = replace(base, y_um=np.round(base.y_um / 0.5) * 0.5)
    assert "line" not in kinds(counts)


def test_a_command_that_rests_under_a_noisy_sensor_is_not_exchanged_where_the_clock_lets_readings_lead() -> None:
    ahead = recording_of(pair(820))
    assert lead(ahead.u_V, ahead.y_um) > LARGEST_LEAD
    assert "swapped" not in kinds(ahead)
    on_time = recording_of(pair(820).without("timing"))
    assert "swapped" in kinds(replace(on_time, u_V=on_time.y_um, y_um=on_time.u_V))


def test_jitter_and_wrong_units() -> None:
    rng = np.random.default_rng(0)
    base = healthy()
    assert kinds(replace(base, t_s=base.t_s + 1e-4 * rng.standard_normal(4000))) == {"jitter": "warning"}
    assert kinds(replace(base, y_um=base.y_um * 1e3)) == {"unit": "warning"}
    assert kinds(replace(base, u_V=base.u_V * 1e-3)) == {"unit": "warning"}
    # Milliseconds that were taken for seconds, or a counter of the samples.
    assert kinds(replace(base, t_s=base.t_s * 1e3, dt_s=base.dt_s * 1e3)) == {"unit": "warning"}


@settings(max_examples=40, deadline=None)
@given(
    gone=st.sets(st.integers(1, 2998), max_size=40),
    nans=st.sets(st.integers(0, 2999), max_size=20),
    doubled=st.sets(st.integers(0, 2999), max_size=20),
)
def test_repair_puts_every_good_sample_where_it_was(gone: set[int], nans: set[int], doubled: set[int]) -> None:
    base = healthy(3000)
    broken = changed(base, y_um=(sorted(nans), np.nan)) if nans else base
    order = np.sort([k for k in range(3000) if k not in gone] + [k for k in doubled if k not in gone])
    broken = replace(broken, t_s=broken.t_s[order], u_V=broken.u_V[order], y_um=broken.y_um[order])
    whole = repaired(broken)
    assert len(whole.recording) == 3000
    invalid = set(np.flatnonzero(~whole.valid).tolist())
    assert invalid == gone | nans
    np.testing.assert_allclose(whole.recording.t_s, base.t_s, atol=1e-12)
    np.testing.assert_array_equal(whole.recording.u_V[whole.valid], base.u_V[whole.valid])
    np.testing.assert_array_equal(whole.recording.y_um[whole.valid], base.y_um[whole.valid])


@pytest.mark.parametrize("name", ["rich", "bouc_wen"])
def test_simulated_stages_are_healthy_and_swapped_ones_are_seen(name: str) -> None:
    from dehyst.sim.signals.voltages import training_input
    from dehyst.sim.stage.presets import preset
    from dehyst.sim.stage.stage import Stage

    t_s, u_V = training_input(DT, 10.0)[:2]
    stage = Stage(preset(name, dt_s=DT))
    y_um, _ = stage.run(stage.initial_state(), u_V)
    assert check(Recording(t_s=t_s, u_V=u_V, y_um=y_um, dt_s=DT)) == []
    assert kinds(Recording(t_s=t_s, u_V=y_um, y_um=u_V, dt_s=DT)) == {"swapped": "refusal"}
