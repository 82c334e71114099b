"""A stage file as the nominal stage, a payload on its mode, a second recording, slips, and modes side by side."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dehyst.adaptive.errors import InputError
from dehyst.adaptive.types import FloatArray
from dehyst.sim.diagnosis.diagnose import diagnose_prepared
from dehyst.sim.diagnosis.export import OFFSET, export_stage
from dehyst.sim.diagnosis.prepare import prepare
from dehyst.sim.diagnosis.result import TEST, Diagnosis
from dehyst.sim.effects import Chain, effect
from dehyst.sim.effects.timing import find_slips
from dehyst.sim.fitting.modes import peaks
from dehyst.sim.recordings import Recording, read
from dehyst.sim.stage.config import StageConfig
from dehyst.sim.stage.stage import Stage
from tests.hidden.foreign.crops import contradict

DT = 1e-3
DATA = Path(os.environ.get("DEHYST_DATA", Path(__file__).parents[4] / "shared" / "data"))
CHAIN = Chain(
    (
        effect("bouc_wen"),
        effect("resonance", frequency_Hz=130.0, damping_ratio=0.03),
        effect("sensor_noise", rms_um=0.005),
    )
)
NOMINAL = StageConfig("with a mode", CHAIN, dt_s=DT)


def drive(times: int = 1) -> FloatArray:
    """9 s: rest, steps, nested triangles, a slow and a fast sine, rest."""
    t = np.arange(round(1.5 / DT)) * DT
    steps = np.repeat([0.0, 4.0, 7.0, 1.5, 5.0, 0.0], round(0.5 / DT))
    sines = [4.0 * (1.0 - np.cos(2.0 * np.pi * f * t)) * a for f, a in ((2.0, 0.9), (14.0, 0.3))]
    turns = np.interp(np.arange(round(2.0 / DT)) * DT, np.linspace(0.0, 2.0, 9), [0, 7.5, 1, 6, 2, 5, 3, 4, 0])
    rest = np.zeros(round(0.6 / DT))
    return np.tile(np.concatenate([rest, steps, turns, *sines, rest]), times)


def recording(
    chain: Chain = CHAIN, changes: tuple[tuple[float, dict[str, float]], ...] = (), seed: int = 3, times: int = 1
) -> Recording:
    """What a recorder would see of this stage."""
    stage = Stage(StageConfig("real", chain, dt_s=DT, seed=seed, changes=changes))
    u = drive(times)
    y, _ = stage.run(stage.initial_state(), u)
    return Recording(t_s=np.arange(u.size) * DT, u_V=u, y_um=y, dt_s=DT)


def names(diagnosis: Diagnosis) -> list[str]:
    return [cause.name for cause in diagnosis.causes]


def test_the_stage_of_a_diagnosis_is_the_nominal_one_of_the_next() -> None:
    """It has an offset of its own, which what is fitted then adds to."""
    offset_um = 3.0
    moved = replace(recording(), y_um=recording().y_um + offset_um)
    first = export_stage(diagnose_prepared(prepare(moved, nominal=NOMINAL))).config
    again = export_stage(diagnose_prepared(prepare(replace(moved, y_um=moved.y_um + 1.0), nominal=first))).config
    for config, expected_um in ((first, offset_um), (again, offset_um + 1.0)):
        (found,) = [e for e in config.effects if e.label == OFFSET]
        assert found.values["offset_um"] == pytest.approx(expected_um, abs=0.05)


def test_a_stage_file_explains_its_own_stage() -> None:
    diagnosis = diagnose_prepared(prepare(recording(), nominal=NOMINAL))
    assert diagnosis.verdict == "adequate"
    assert diagnosis.nominal.model.nominal.name == "stage"
    assert diagnosis.extended_heldout_um < 1.1 * 0.005


def test_a_payload_throughout_moves_the_known_mode() -> None:
    loaded = CHAIN + effect("payload_change", payload_ratio=0.4)
    diagnosis = diagnose_prepared(prepare(recording(loaded), nominal=NOMINAL))
    assert names(diagnosis) == ["payload_change"]
    # The file's frequency is believed to 1.5 %, so the mass to twice that.
    assert diagnosis.causes[0].parameters["payload_ratio"] == pytest.approx(0.4, abs=0.06)
    assert diagnosis.extended_heldout_um < 1.5 * 0.005


def test_a_payload_put_on_midway_is_dated() -> None:
    changes = ((9.4, {"resonance.payload_ratio": 0.4}),)
    diagnosis = diagnose_prepared(prepare(recording(changes=changes, times=2), nominal=NOMINAL))
    assert names(diagnosis) == ["payload_change"]
    numbers = diagnosis.causes[0].parameters
    assert numbers["payload_ratio"] == pytest.approx(0.4, abs=0.02)
    # Between 8.0 s and 9.7 s nothing rings, so that the moment within is anybody's guess.
    assert 7.5 < numbers["change_s"] < 10.2


def test_an_unknown_nominal_stage_is_refused() -> None:
    with pytest.raises(InputError, match="nominal"):
        prepare(recording(), nominal="quadratic")


def test_held_out_errors_come_from_the_test_recording() -> None:
    creeping = CHAIN + effect("creep", gain_per_decade=0.015)
    prepared = prepare(recording(creeping), nominal=NOMINAL, test=recording(creeping, seed=9, times=2))
    diagnosis = diagnose_prepared(prepared)
    assert names(diagnosis) == ["creep"]
    assert diagnosis.heldout_source == TEST
    assert diagnosis.extended_heldout_um < 0.3 * diagnosis.nominal_heldout_um
    other = Recording(t_s=np.arange(9000) * 2.0 * DT, u_V=drive()[:9000], y_um=drive()[:9000], dt_s=2.0 * DT)
    with pytest.raises(InputError, match="sample time"):
        prepare(recording(), nominal=NOMINAL, test=other)


def test_lost_rows_are_found_where_motion_shows_them() -> None:
    rng = np.random.default_rng(0)
    t = np.arange(12_000) * DT
    model = 20.0 * np.sin(2.0 * np.pi * 6.0 * t) * np.sin(2.0 * np.pi * 0.31 * t)
    y = model + 0.005 * rng.standard_normal(t.size)
    whole = np.ones(t.size, dtype=np.bool_)
    assert find_slips(y, model, whole) == ()
    lost = np.delete(y, [3000, 8000])
    lost = np.append(lost, lost[-2:])
    found = find_slips(lost, model, whole)
    assert [size for _, size in found] == [1, 1]
    assert [at for at, _ in found] == [pytest.approx(3000, abs=60), pytest.approx(8000, abs=60)]


def test_a_row_lost_without_a_gap_is_a_finding_about_timing() -> None:
    healthy = recording(times=2)
    keep = np.ones(len(healthy), dtype=np.bool_)
    keep[5200] = False
    y = np.append(healthy.y_um[keep], healthy.y_um[-1])
    diagnosis = diagnose_prepared(
        prepare(Recording(t_s=healthy.t_s, u_V=healthy.u_V, y_um=y, dt_s=DT), nominal=NOMINAL)
    )
    assert names(diagnosis) == ["timing"]
    numbers = diagnosis.causes[0].parameters
    assert numbers["lost_samples"] == pytest.approx(1.0, abs=0.05)
    assert numbers["first_slip_s"] == pytest.approx(5.2, abs=0.3)


def test_modes_side_by_side_are_found_in_a_spectrum() -> None:
    n, dt = 8192, 1.0 / 6400.0
    rng = np.random.default_rng(1)
    x = rng.standard_normal(n)
    f = np.fft.rfftfreq(n, dt)
    response = sum(
        share / (1.0 - (f / f0) ** 2 + 2j * z * f / f0)
        for f0, z, share in ((635.0, 0.01, 0.3), (925.0, 0.008, -0.5), (2110.0, 0.015, 0.2))
    )
    y = np.fft.irfft(np.fft.rfft(x) * response, n)
    modes = peaks(x, y, dt, 5)
    for f0 in (635.0, 925.0, 2110.0):
        assert min(abs(m.f_hz - f0) for m in modes) < 0.01 * f0


def _mirror(part: str) -> Recording:
    path = DATA / "fine_steering_mirror" / f"fsm_100mV_{part}.npz"
    if not path.exists():
        pytest.skip(f"measured data missing: {path.name}; set DEHYST_DATA to the folder that holds it")
    with np.load(path) as file:
        u, y = file["u"].astype(np.float64), file["y_um"].astype(np.float64)
    u1, u2, u3 = (np.ascontiguousarray(u[:, j, 0, 0]) for j in (2, 0, 1))
    y1 = np.ascontiguousarray(y[:, 0, 0, 0])
    return Recording(t_s=np.arange(u1.size) / 6400.0, u_V=u1, y_um=y1, dt_s=1.0 / 6400.0, u2_V=u2, u3_V=u3)


@pytest.mark.slow
def test_the_mirrors_modes_and_cross_talk_are_found_unaided() -> None:
    diagnosis = diagnose_prepared(prepare(_mirror("train"), nominal="linear", test=_mirror("test")))
    # Stacks have a loop, too: a small one may be named beside them.
    assert {"cross_talk", "resonance"} <= set(names(diagnosis)) <= {"cross_talk", "resonance", "hysteresis_shape"}
    assert diagnosis.extended_heldout_um < 0.4 * diagnosis.nominal_heldout_um
    numbers = [c.parameters for c in diagnosis.causes]
    seen = [v for p in numbers for key, v in p.items() if key.startswith("f0")]
    for known in (925.0, 2110.0):
        assert min(abs(f - known) for f in seen) < 0.02 * known


def test_a_part_of_the_stacks_record_contradicts_the_whole_nowhere() -> None:
    """The part begins in motion, where creep is as good as a drift; and a rate dependence had taken the lag's place."""
    folder = DATA / "picma_stack"
    if not folder.exists():
        pytest.skip("measured data missing: picma_stack; set DEHYST_DATA to the folder that holds it")
    whole = read(folder / "model_sine_1hz.csv")
    part = diagnose_prepared(prepare(whole.part(len(whole) // 4, len(whole))))
    # What the whole record shows, and the loop's shape, which has been named there, too.
    of_whole = (
        ("asymmetry", "sensor_nonlinearity"),
        ("sensor_lag", "amplifier_lag"),
        ("creep",),
        ("hysteresis_shape",),
    )
    of_part = tuple((c.name, *c.alternatives) for c in part.causes)
    assert not contradict(of_whole, of_part), of_part
    # A drift of less than 0.2 % of the motion is left over and not named.
    assert part.extended_heldout_um < 0.13


def test_the_measured_stack_creeps_and_nothing_doubtful_is_said() -> None:
    folder = DATA / "picma_stack"
    if not folder.exists():
        pytest.skip("measured data missing: picma_stack; set DEHYST_DATA to the folder that holds it")
    diagnosis = diagnose_prepared(prepare(read(folder / "model_sine_1hz.csv").part(0, 4000)))
    found = set(names(diagnosis))
    assert diagnosis.verdict == "effects"
    # In twenty seconds the means of equal cycles follow the logarithm of time and a slow exponential alike.
    (slow,) = [
        c for c in diagnosis.causes if "creep" in (c.name, *c.alternatives) and c.name in ("creep", "thermal_drift")
    ]
    # Its height settles, and its clock is right.
    assert not found & {"gain_drift", "timing"}
    assert slow.witness is not None
    assert slow.witness.seen is True
