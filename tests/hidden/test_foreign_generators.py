"""The foreign generators are what they say: hysteresis of six kinds, effects of the stated size, noise of known colour.

Also the scorer's judgement, on answers made by hand.
"""

from __future__ import annotations

import ast
import itertools
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import linregress

from tests.hidden.foreign import bases, effects
from tests.hidden.foreign import noise as noises
from tests.hidden.foreign.bases import BASES, OTHER_CLASS, Array
from tests.hidden.foreign.cases import CAUSES, EXCLUSIVE, LEAST_OWN, LEAST_RMS, change, healthy, pair, single, triple
from tests.hidden.foreign.crops import contradict
from tests.hidden.foreign.drives import SHOWS, drive
from tests.hidden.foreign.record import Case, Rig, record
from tests.hidden.foreign.score import covered, judge, run_case
from tests.hidden.foreign.truth_numbers import true_numbers

FS = 2000.0
HERE = Path(__file__).parent / "foreign"


def path(*levels: float, step: float = 0.002) -> Array:
    """Straight moves from level to level."""
    parts = [np.array([levels[0]])]
    for a, b in itertools.pairwise(levels):
        count = max(2, round(abs(b - a) / step))
        parts.append(a + (b - a) * np.arange(1, count + 1) / count)
    return np.concatenate(parts)


def end(base: str, *levels: float) -> float:
    return float(BASES[base](path(*levels), np.random.default_rng(4))[-1])


# Bases ---------------------------------------------------------------------------------------------------------------


def test_the_generators_import_nothing_of_the_project() -> None:
    for name in ("bases", "effects", "noise", "drives", "record", "cases", "truth_numbers"):
        tree = ast.parse((HERE / f"{name}.py").read_text(encoding="utf-8"))
        modules = {node.module or "" for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}
        modules |= {alias.name for node in ast.walk(tree) if isinstance(node, ast.Import) for alias in node.names}
        assert {module.split(".")[0] for module in modules} <= {
            "__future__",
            "collections",
            "dataclasses",
            "itertools",
            "numba",
            "numpy",
            "scipy",
            "tests",
            "typing",
        }, name


@pytest.mark.parametrize("base", BASES)
def test_a_base_rises_to_one_with_a_loop_symmetric_about_its_middle(base: str) -> None:
    x = path(0.0, 1.0, 0.0, 1.0, 0.0)
    for seed in range(3):
        w, remains = bases.displacement(base, x, False, np.random.default_rng(seed))
        assert remains == 0.0
        assert w[0] == pytest.approx(0.0, abs=1e-12)
        assert float(w.max()) == pytest.approx(1.0, abs=0.08)
        up, down = w[1000:1501], w[1500:2001]
        width = float(np.max(down[::-1] - up)) / float(np.ptp(up))
        assert 0.05 < width < 0.2
        # A depolarised stage does not come back to where it began; one that was used before does.
        assert 0.01 < float(w[-1]) < 0.15
        again, remains = bases.displacement(base, x, True, np.random.default_rng(seed))
        assert again[0] == pytest.approx(remains, abs=1e-3)
        assert float(again[-1]) == pytest.approx(remains, abs=1e-3)
        # Turned about its centre the loop is the same.
        assert down - down[0] == pytest.approx(-(up - up[0]), abs=1e-3)


@pytest.mark.parametrize("base", ["preisach", "maxwell_slip", "play_sum"])
def test_small_excursions_are_wiped_out_by_larger_ones(base: str) -> None:
    assert end(base, 0.0, 0.8, 0.3, 0.6, 0.4, 0.6, 0.9) == pytest.approx(end(base, 0.0, 0.9), abs=1e-9)
    assert end(base, 0.0, 0.8, 0.3, 0.6, 0.4, 0.6, 0.65) == pytest.approx(end(base, 0.0, 0.8, 0.3, 0.65), abs=1e-9)
    assert end(base, 0.0, 0.8, 0.3, 0.6, 0.2) == pytest.approx(end(base, 0.0, 0.8, 0.2), abs=1e-9)
    # The memory is there: the way to one level matters.
    assert abs(end(base, 0.0, 0.8, 0.5) - end(base, 0.0, 0.5)) > 0.02


@pytest.mark.parametrize("base", ["bouc_wen", "jiles_atherton", "coleman_hodgdon"])
def test_models_with_local_memory_wipe_nothing_out(base: str) -> None:
    assert abs(end(base, 0.0, 0.8, 0.3, 0.6, 0.4, 0.6, 0.65) - end(base, 0.0, 0.8, 0.3, 0.65)) > 5e-4


def test_minor_loops_of_relays_are_congruent_but_change_with_the_bias() -> None:
    def height(base: str, *levels: float) -> float:
        return end(base, *levels[:-1]) - end(base, *levels)

    # Between the same turning points, with another history: the same loop.
    one, two = height("preisach", 0.0, 0.9, 0.3, 0.5, 0.3), height("preisach", 0.0, 0.55, 0.3, 0.5, 0.3)
    assert one == pytest.approx(two, abs=1e-9)
    # A sum of plays has the same loop at every bias; relays of this density, and friction under a force, do not both.
    low, high = height("play_sum", 0.0, 0.9, 0.1, 0.3, 0.1), height("play_sum", 0.0, 0.9, 0.5, 0.7, 0.5)
    assert low == pytest.approx(high, abs=1e-9)
    low, high = height("preisach", 0.0, 1.0, 0.0, 0.2, 0.0), height("preisach", 0.0, 1.0, 0.4, 0.6, 0.4)
    assert abs(low - high) > 1e-3


def test_relays_switch_where_the_density_says() -> None:
    """Against relays that are switched one by one, four by four of them in each cell of the density."""
    grid, density = bases.preisach_density(0.08, 0.06, 0.8)
    fine = np.linspace(grid[0], grid[-1], 4 * density.shape[0] + 1)
    threshold = 0.5 * (fine[1:] + fine[:-1])
    # Up at alpha (rows), down at beta < alpha (columns). On the diagonal half of a square counts.
    weight = np.kron(density, np.ones((4, 4)))
    weight = np.tril(weight, -1) + 0.5 * np.diag(np.diag(weight))
    # Depolarised: up where alpha + beta < 0. A relay of the line itself is neither.
    up = threshold[:, None] + threshold[None, :] < 0.0
    levels = np.abs((np.cumsum(0.15 * np.random.default_rng(1).standard_normal(60)) % 2.0) - 1.0)
    levels[0] = 0.0
    start, expected = float(weight[up].sum()), []
    for level in levels.tolist():
        up[threshold <= level, :] = True
        up[:, threshold >= level] = False
        expected.append(float(weight[up].sum()) - start)
    step = float(grid[1] - grid[0])
    cumulative = np.zeros((grid.size, grid.size))
    # Each cell of the density counts as the sixteen relays in it.
    cumulative[1:, 1:] = 16.0 * np.cumsum(np.cumsum(density, axis=0), axis=1)
    got = bases._preisach(levels, cumulative, float(grid[0]), step)
    assert got == pytest.approx(np.array(expected), abs=0.015 * float(np.max(got)))
    assert float(np.ptp(got)) > 0.6 * float(np.max(got))


def test_a_reversal_of_friction_elements_is_the_first_rise_twice_as_large() -> None:
    """Masing's rule, in force and position."""
    first = bases.maxwell_slip(path(0.0, 0.4), np.random.default_rng(2))
    w = bases.maxwell_slip(path(0.0, 1.0, 0.2), np.random.default_rng(2))
    fall = w[500] - w[500:]
    assert fall[::2] == pytest.approx(2.0 * first, abs=1e-9)


def test_polarisation_without_pinning_follows_its_anhysteretic_curve() -> None:
    field = path(-1.0, 1.0, -1.0)

    def widest(pinning: float) -> float:
        m = bases._jiles(field, -1.0 / 3.0, 1.0, 0.0, pinning, 0.0)
        anhysteretic = 1.0 / np.tanh(np.where(field == 0.0, 1e-9, field)) - 1.0 / np.where(field == 0.0, 1e-9, field)
        return float(np.max(np.abs(m[300:] - np.where(np.abs(field) < 1e-6, 0.0, anhysteretic)[300:])))

    assert widest(0.005) < 0.004
    assert widest(0.3) > 0.04


def test_the_duhem_form_solves_its_equation() -> None:
    x = path(0.0, 0.6, step=1e-4)
    w = bases._coleman(x, 0.0, 5.0, 0.8, 0.1, 0.3)
    z = x - 0.5
    slope = 5.0 * (0.8 * z + 0.1 * np.arctan(2.0 * z) - w) + 0.3
    assert np.gradient(w, x)[1:-1] == pytest.approx(slope[1:-1], abs=1e-5)


def test_the_nominal_class_rises_by_its_exponential() -> None:
    x = path(0.0, 0.5)
    h = bases._bouc_wen(x, 0.46, 7.0, 7.7)
    assert h == pytest.approx(0.46 / 14.7 * (1.0 - np.exp(-14.7 * x)), abs=1e-7)


@pytest.mark.parametrize("base", OTHER_CLASS)
def test_a_foreign_base_is_neither_nominal_nor_far_from_it(base: str) -> None:
    """What the best nominal loop leaves, and what plays leave beside it, as shares of the range.

    Plays hold the bases that wipe out; those with local memory are beyond them by a few tenths of a per cent.
    """
    x, _ = drive("mixed", 30_000, 1000.0, np.random.default_rng(2))
    w = BASES[base](x, np.random.default_rng(1))

    def left(columns: list[Array]) -> float:
        matrix = np.column_stack([np.ones(x.size), x, *columns])
        return float(np.std(w - matrix @ np.linalg.lstsq(matrix, w, rcond=1e-9)[0]))

    nominal = [
        bases._bouc_wen(x, 0.46, rise, rise + bend) for rise in (0.5, 1.5, 3.0, 5.0, 8.0, 13.0) for bend in (-0.4, 1.0)
    ]
    plays = [bases._plays(x, np.array([r]), np.ones(1)) for r in np.geomspace(0.01, 0.5, 24)]
    alone = min(left([h]) for h in nominal)
    assert alone > 1e-3
    beside = left([nominal[-1], *plays])
    if base in ("jiles_atherton", "coleman_hodgdon"):
        assert 1e-3 < beside < 6e-3
    else:
        assert beside < min(0.5 * alone, 2e-3)


# Noise ---------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", noises.KINDS)
def test_noise_has_its_standard_deviation(kind: str) -> None:
    rows = [noises.noise(kind, 40_000, 1e-3, 0.007, np.random.default_rng(seed)) for seed in range(30)]
    assert float(np.sqrt(np.mean(np.square(rows)))) == pytest.approx(0.007, rel=0.06)


def test_noise_has_its_colour() -> None:
    n, dt = 200_000, 1e-3
    x = noises.noise("correlated", n, dt, 1.0, np.random.default_rng(1))
    for lag_s in (0.02, 0.05, 0.1):
        k = round(lag_s / dt)
        assert float(np.mean(x[k:] * x[:-k])) == pytest.approx(np.exp(-lag_s / 0.05), abs=0.05)
    white = noises.noise("white", n, dt, 1.0, np.random.default_rng(1))
    assert abs(float(np.mean(white[1:] * white[:-1]))) < 0.01
    y = noises.noise("pink", n, dt, 1.0, np.random.default_rng(1))
    power = np.abs(np.fft.rfft(y)) ** 2
    f = np.fft.rfftfreq(n, dt)
    edges = np.geomspace(0.2, 400.0, 20)
    means = [power[(f >= a) & (f < b)].mean() for a, b in itertools.pairwise(edges)]
    slope = linregress(np.log(np.sqrt(edges[1:] * edges[:-1])), np.log(means)).slope
    assert slope == pytest.approx(-1.0, abs=0.1)


# Drives --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", SHOWS)
def test_a_drive_stays_in_range_and_rests_at_both_ends(kind: str) -> None:
    n = 130_000 if kind == "excitation" else 60_000
    x, x2 = drive(kind, n, FS, np.random.default_rng(3))
    assert x.shape == x2.shape == (n,)
    assert -1e-12 <= min(x.min(), x2.min()) <= max(x.max(), x2.max()) <= 1.0
    # The nominal stage begins at rest at 0 V; the floor is taken from rests.
    assert not np.any(x[: round(0.5 * FS)])
    assert not np.any(x[-round(0.5 * FS) :])
    assert float(np.ptp(x)) > 0.75
    assert bool(np.any(x2)) == ("cross_talk" in SHOWS[kind])


def test_every_cause_is_shown_by_some_drive() -> None:
    assert set.union(*SHOWS.values()) == set(CAUSES)


# Effects -------------------------------------------------------------------------------------------------------------

STEP = np.r_[np.zeros(2000), np.ones(18_000)]
T = np.arange(STEP.size) / FS


def test_lags_delays_and_limits() -> None:
    lagged = effects.first_order(STEP, 0.01, FS)
    # The input rises over one step of the grid.
    assert lagged[2000 + 20 : 2200] == pytest.approx(1.0 - np.exp(-(np.arange(20, 200) + 0.5) / 20.0), abs=1e-3)
    late = effects.delayed(STEP, 0.0035, FS)
    assert int(np.argmax(late > 0.5)) == 2007
    slow = effects.slew_limit(5.0 * STEP, 50.0, FS)
    assert float(np.max(np.diff(slow))) * FS == pytest.approx(50.0, rel=1e-3)
    assert float(slow[2000 + 100]) == pytest.approx(50.0 * 100 / FS, rel=0.01)
    ramp = np.linspace(0.0, 10.0, 1000)
    flat = effects.saturation(ramp, 8.0, 0.005)
    assert float(flat[-1]) == pytest.approx(8.0, abs=1e-6)
    assert flat[:780] == pytest.approx(ramp[:780], abs=1e-6)


def test_a_mode_rings_at_its_frequency_with_its_damping() -> None:
    fs, f, z = 16_000.0, 200.0, 0.02
    x = np.r_[np.zeros(100), np.ones(8000)]
    ring = effects.modes(x, [f], [z], [1.0], fs)[100:] - 1.0
    cross = np.flatnonzero((ring[:-1] < 0.0) & (ring[1:] >= 0.0)) + 0.0
    assert fs / float(np.mean(np.diff(cross[:20]))) == pytest.approx(f * np.sqrt(1 - z * z), rel=3e-3)
    per_cycle = round(fs / f)
    tops = [float(np.max(np.abs(ring[i * per_cycle : (i + 1) * per_cycle]))) for i in range(1, 9)]
    assert float(-np.mean(np.diff(np.log(tops)))) == pytest.approx(2 * np.pi * z, rel=0.03)
    two = effects.modes(x, [200.0, 330.0], [z, z], [0.9, 0.1], fs)
    assert float(two[-1]) == pytest.approx(1.0, abs=1e-3)
    assert float(np.max(np.abs(two[100:] - 1.0 - ring))) > 0.05


def test_a_payload_moves_the_mode_from_its_moment_on() -> None:
    fs = 16_000.0
    x = np.r_[np.zeros(100), np.ones(16_000), np.zeros(16_000)]
    y = effects.loaded_mode(x, 200.0, 0.01, 0.44, 16_000, fs)
    rate = []
    for part in (y[100:4100] - 1.0, y[16_100:20_100]):
        cross = np.flatnonzero((part[:-1] < 0.0) & (part[1:] >= 0.0))
        rate.append(fs / float(np.mean(np.diff(cross))))
    assert rate[0] == pytest.approx(200.0, rel=0.01)
    assert rate[1] == pytest.approx(200.0 / 1.2, rel=0.01)


def test_slow_effects_end_at_their_totals() -> None:
    crept = STEP + effects.creep(STEP, 0.02, 0.15, FS)
    law = 0.02 * ((1.0 + np.array([1.0, 8.0]) / 0.05) ** 0.15 - 1.0)
    assert crept[[2000 + 2000, 2000 + 16_000]] - 1.0 == pytest.approx(law, abs=1e-9)
    assert effects.thermal_drift(T, 0.7, 3.0)[[0, -1]] == pytest.approx([0.0, 0.7], abs=1e-12)
    assert effects.gain_drift(T, -0.01)[[0, -1]] == pytest.approx([0.0, -0.01], abs=1e-12)


def test_friction_sticks_after_a_reversal_and_slides_its_reach_behind() -> None:
    y = path(0.0, 1.0, 0.0, step=1e-4)
    rubbed = effects.stick_slip(y, 0.01)
    assert float(y[9999] - rubbed[9999]) == pytest.approx(0.01, rel=1e-6)
    assert float(y[-1] - rubbed[-1]) == pytest.approx(-0.01, rel=1e-6)
    # Over the first tenth of the reach after the reversal hardly any motion, and none the wrong way.
    first = rubbed[10_000:10_011]
    assert np.all(np.diff(first) <= 0.0)
    assert first[0] - first[-1] < 0.05 * (y[10_000] - y[10_010])


def test_the_loop_widens_by_its_share_per_decade() -> None:
    x = np.concatenate([path(0.0, 1.0, 0.0, step=step) for step in (1e-4, 1e-3)])
    w = x - 0.05 * np.sign(np.gradient(x))
    wide = effects.rate_dependence(x, w, 0.08, 0.1 * 1e-4 * FS, FS)
    # The rates are ten and a hundred times the corner.
    loops = np.abs(x - wide)
    assert (loops[-300] - loops[8000]) / 0.05 == pytest.approx(0.08, rel=0.02)


def test_asymmetry_changes_its_sign_when_the_loop_is_turned() -> None:
    x = path(0.0, 1.0, 0.0, 1.0, 0.0)
    bend = effects.branch_curvature(x, 0.02)
    up, down = bend[1000:1501], bend[1500:2001]
    # A symmetric loop would have down = -up (both from their turning points).
    assert down[100:] == pytest.approx(up[100:], abs=2e-4)
    assert float(np.max(np.abs(bend))) == pytest.approx(0.02, rel=0.2)
    assert effects.dead_zone(np.array([0.2, 0.5, 1.0]), 0.5, 0.04) == pytest.approx([0.0, 0.0, 0.02])


def test_effects_of_the_reading() -> None:
    hum = effects.mains_hum(T, 50.0, 0.01)
    assert float(np.std(hum)) == pytest.approx(0.01 * np.sqrt(0.5 * (1.0 + 0.01 + 0.0625)), rel=1e-3)
    y = 0.3 * np.sin(7.0 * T)
    grid = effects.quantisation(y, 0.004)
    assert float(np.sqrt(np.mean((grid - y) ** 2))) == pytest.approx(0.004 / np.sqrt(12.0), rel=0.03)
    assert np.unique(np.round((grid - 0.002) / 0.004, 6) % 1.0).size == 1
    curve = effects.sensor_nonlinearity(np.linspace(0.0, 100.0, 101), 0.001, 100.0)
    assert curve[[0, -1]] == pytest.approx([0.0, 0.0], abs=1e-12)
    assert float(np.max(curve)) == pytest.approx(0.1, rel=0.15)
    assert effects.slips(np.arange(10.0), np.array([3.0, 6.0]), np.ones(2)).tolist() == [0, 1, 2, 4, 5, 7, 8, 9, 9, 9]
    assert effects.slips(np.arange(6.0), np.array([2.0]), -np.ones(1)).tolist() == [0, 1, 2, 2, 3, 4]


# Cases ---------------------------------------------------------------------------------------------------------------


def rig(**changes: object) -> Rig:
    known = {
        "seed": 5,
        "base": "play_sum",
        "used_before": False,
        "drive": "mixed",
        "noise": "white",
        "fs_hz": 1000.0,
        "duration_s": 20.0,
        "span_V": 100.0,
        "stroke_um": 50.0,
        "lag_s": 1e-3,
        "straight": False,
        "early": 0.0,
        "sigma_um": 0.0,
        "offset_um": 1.0,
    }
    return Rig(**(known | changes))  # type: ignore[arg-type]


def test_a_case_is_the_same_at_every_draw_and_another_with_every_seed() -> None:
    for draw, seed in ((single, 9), (pair, 1), (triple, 4), (healthy, 1)):
        one, two = draw(seed), draw(seed)
        assert one == two
        assert np.array_equal(record(one)["y_um"], record(two)["y_um"])
    assert healthy(1) != healthy(2)
    assert single(9).rig != single(9 + len(CAUSES)).rig


def test_the_causes_take_turns_and_their_sizes_are_those_of_the_record() -> None:
    for seed, name in enumerate(CAUSES):
        case = single(seed)
        assert case.hidden == (name,)
        assert case.rig.base in OTHER_CLASS or name != "hysteresis_shape"
        columns = record(case)
        assert all(np.all(np.isfinite(values)) for values in columns.values())
        assert 20.0 <= case.rig.duration_s <= 70.0 or case.rig.n == 200_000
        assert case.rig.drive in {kind for kind, shown in SHOWS.items() if name in shown}
        if name not in case.sizes:
            continue
        # Without the effect, with the same noise: the difference has the stated size.
        plain = record(case.without(name))
        rms = float(np.sqrt(np.mean((columns["y_um"] - plain["y_um"]) ** 2)))
        slack = 2.0 * case.rig.sigma_um if name in ("quantisation", "sensor_lag", "timing") else 1e-9
        assert rms == pytest.approx(case.sizes[name] * case.rig.stroke_um, abs=slack, rel=1e-6)
        assert rms >= LEAST_RMS * case.rig.sigma_um


def test_a_loop_grows_with_the_rate_by_the_same_whatever_went_before_the_record() -> None:
    grown = []
    for used_before in (False, True):
        stage = rig(drive="triangles", used_before=used_before)
        case = Case("single", 5, stage, {"rate_dependence": {"per_decade": 0.1, "corner_per_s": 0.1}})
        more = record(case)["y_um"] - record(case.without("rate_dependence"))["y_um"]
        # The second half of the record remembers nothing of what was before it.
        grown.append(more[more.size // 2 :])
    assert grown[1] == pytest.approx(grown[0], abs=1e-6)


def test_several_causes_can_all_be_seen_and_told_apart() -> None:
    for case in (pair(0), pair(1), triple(4)):
        names = set(case.hidden)
        assert len(names) == {"pair": 2, "triple": 3}[case.kind]
        assert not any(len(group & names) > 1 for group in EXCLUSIVE)
        if "rows" in case.effects.get("timing", {}):
            continue
        whole = record(case.quiet())
        for name in names:
            found = change(case, name, whole)
            assert found is not None
            assert found[0] >= LEAST_RMS * case.rig.sigma_um
            assert found[1] >= 0.999 * LEAST_OWN * case.rig.sigma_um


def test_a_healthy_case_holds_nothing_but_its_noise() -> None:
    for seed in range(3):
        case = healthy(seed)
        assert case.effects == {}
        assert case.rig.noise == noises.KINDS[seed]
        assert case.allowed == frozenset()
        rest = record(case)["y_um"] - record(case.quiet())["y_um"]
        assert float(np.std(rest)) == pytest.approx(case.rig.sigma_um, rel=0.35 if case.rig.noise == "pink" else 0.1)
    # The first stands on Preisach, whose loops are not point-symmetric; the second on plays, whose loops are.
    assert (healthy(3).rig.base, healthy(3).allowed) == ("preisach", {"hysteresis_shape", "asymmetry"})
    assert (healthy(4).rig.base, healthy(4).allowed) == ("play_sum", {"hysteresis_shape"})


def test_the_record_of_timing() -> None:
    clean = record(Case("single", 0, rig()))
    fast = record(Case("single", 0, rig(), {"timing": {"ppm": 500.0}}))
    # At the end the reading is 10 ms ahead, ten samples.
    moving = slice(15_000, 18_500)
    early = clean["y_um"][15_000:18_520]
    shift = [float(np.sum((fast["y_um"][moving] - early[k : k + 3500]) ** 2)) for k in range(20)]
    assert int(np.argmin(shift)) in (7, 8, 9)
    rows = record(Case("single", 0, rig(), {"timing": {"rows": 7.0}}))
    assert all(values.size == clean["t_s"].size - 7 for values in rows.values())
    gaps = np.round(np.diff(rows["t_s"]) * 1000.0)
    assert int(np.sum(gaps - 1.0)) == 7


def test_the_other_axis_shows_only_where_there_is_cross_talk() -> None:
    clean = record(Case("single", 0, rig()))
    talk = record(Case("single", 0, rig(), {"cross_talk": {"share": 0.01, "rate_s": 0.0}}))
    assert talk["y_um"] - clean["y_um"] == pytest.approx(0.01 * clean["y2_um"], abs=1e-3)
    assert float(np.max(clean["y2_um"])) > 5.0


# Judgement -----------------------------------------------------------------------------------------------------------

NONE: frozenset[str] = frozenset()
SHAPE = frozenset({"hysteresis_shape"})


def test_one_cause_is_right_alone_in_a_narrow_set() -> None:
    assert judge(["creep"], NONE, "effects", [("creep",)]).right
    assert judge(["creep"], NONE, "effects", [("thermal_drift", "creep", "gain_drift")]).right
    wide = judge(["creep"], NONE, "effects", [("creep", "thermal_drift", "gain_drift", "timing")])
    assert wide.wide == ("creep",)
    assert wide.found == ("creep",)
    assert not wide.right
    assert judge(["creep"], NONE, "adequate", []).missed == ("creep",)
    assert judge(["creep"], NONE, "unexplained", [("creep",)]).missed == ("creep",)
    both = judge(["creep"], NONE, "effects", [("creep",), ("timing", "delay")])
    assert both.extra == ("timing",)
    assert not both.right


def test_the_shape_may_stand_beside_the_truth_on_another_class() -> None:
    named = [("creep",), ("hysteresis_shape",)]
    assert judge(["creep"], SHAPE, "effects", named).right
    assert judge(["creep"], NONE, "effects", named).extra == ("hysteresis_shape",)
    assert judge(["hysteresis_shape"], SHAPE, "effects", [("hysteresis_shape",)]).right
    assert not judge(["hysteresis_shape"], SHAPE, "adequate", []).right
    # It excuses one set only.
    twice = judge(["creep"], SHAPE, "effects", [*named, ("asymmetry", "hysteresis_shape")])
    assert twice.extra == ("asymmetry",)


def test_each_set_counts_for_one_cause() -> None:
    two = ["creep", "saturation"]
    assert judge(two, NONE, "effects", [("saturation",), ("creep",)]).right
    assert judge(two, NONE, "effects", [("saturation", "creep")]).missed
    # The first set could be either; the second one decides.
    assert judge(two, NONE, "effects", [("creep", "saturation"), ("creep",)]).right
    # One voltage and one sensor do not tell lags apart.
    assert judge(["amplifier_lag"], NONE, "effects", [("sensor_lag", "delay")]).right
    assert judge(["amplifier_lag"], NONE, "effects", [("sensor_lag",), ("delay",)]).extra


def test_a_healthy_record_is_left_alone() -> None:
    assert judge([], NONE, "adequate", []).right
    assert not judge([], NONE, "unexplained", []).right
    assert judge([], NONE, "effects", [("timing",)]).extra == ("timing",)
    assert judge([], SHAPE, "effects", [("hysteresis_shape",)]).right


def test_intervals_are_held_against_true_numbers() -> None:
    case = Case("single", 0, rig(early=0.5), {"delay": {"tau_s": 0.004}, "gain_drift": {"total": -0.01}})
    assert true_numbers(case)["delay"]["tau_s"][0] == pytest.approx(0.0045)
    said = [("gain_drift", {"gain": (-0.012, -0.009), "rate_per_s": (0.0, 1.0)}), ("delay", {"tau_s": (0.005, 0.006)})]
    gain, delay = covered(case, said)
    assert gain.held
    assert not delay.held
    assert covered(case, [("creep", {"gain_per_decade": (0.0, 1.0)})]) == ()


@pytest.mark.parametrize(("f_hz", "fs_hz"), [(400.0, 4000.0), (150.0, 500.0)])
def test_the_true_damping_is_that_of_the_ring_down(f_hz: float, fs_hz: float) -> None:
    """The trapezoidal rule damps less than was stated, by more than the width of a good interval."""
    case = Case("single", 0, rig(fs_hz=fs_hz), {"resonance": {"f_Hz": f_hz, "damping": 0.02}})
    fine_hz = fs_hz * case.rig.over
    hit = np.zeros(int(0.2 * fine_hz))
    hit[0] = 1.0
    y = effects.modes(hit, [f_hz], [0.02], [1.0], fine_hz)[4:]
    # y[k] = 2 r cos(phi) y[k - 1] - r² y[k - 2] in a free motion, and the pole is fs (ln r + j phi).
    (b, a), *_ = np.linalg.lstsq(np.stack([y[1:-1], y[:-2]], axis=1), y[2:], rcond=None)
    pole = fine_hz * complex(0.5 * np.log(-a), np.arccos(b / (2.0 * np.sqrt(-a))))
    true = true_numbers(case)["resonance"]
    assert true["f0_hz"] == pytest.approx((abs(pole) / (2.0 * np.pi),), rel=1e-6)
    assert true["damping"] == pytest.approx((-pole.real / abs(pole),), rel=1e-5)
    assert abs(true["damping"][0] / 0.02 - 1.0) > 0.0005


def test_the_dead_time_of_a_record_is_the_stated_one() -> None:
    """The delay and the early reading; a held voltage steps at its sample, not before it."""
    for straight in (False, True):
        case = Case("single", 0, rig(early=0.5, straight=straight), {"delay": {"tau_s": 0.004}})
        plain, late = record(case.without("delay"))["y_um"], record(case)["y_um"]
        assert late[4:] == pytest.approx(plain[:-4], abs=1e-9)
        assert true_numbers(case)["delay"]["tau_s"][0] == pytest.approx(0.0045, abs=1e-9)
    # Step response of the stage's lag of 1 ms, read early: the part still missing is exp(-(t - early) / lag).
    columns = record(Case("single", 0, rig(early=0.5)))
    edge = int(np.flatnonzero(np.diff(columns["u_V"]))[0]) + 1
    step = columns["y_um"][edge : edge + 12] - columns["y_um"][edge - 2]
    settled = float(columns["y_um"][edge + 40] - columns["y_um"][edge - 2])
    missing = np.exp(-np.maximum(np.arange(12) - 0.5, 0.0))
    assert 1.0 - step / settled == pytest.approx(missing, abs=1e-3)


@pytest.mark.parametrize(
    ("one", "other", "expected"),
    [
        ([], [("creep",)], False),
        ([("creep",)], [("creep",), ("delay",)], False),
        ([("creep", "thermal_drift")], [("thermal_drift",)], False),
        ([("creep",)], [("thermal_drift",)], True),
        ([("creep",), ("delay",)], [("creep",), ("resonance",)], True),
    ],
)
def test_answers_contradict_when_each_names_what_the_other_lacks(
    one: list[tuple[str, ...]], other: list[tuple[str, ...]], expected: bool
) -> None:
    assert contradict(tuple(one), tuple(other)) is expected
    assert contradict(tuple(other), tuple(one)) is expected


def test_lost_rows_are_found_as_a_defect_of_the_recording() -> None:
    """A recorder that loses rows is no cause in the stage; the answer says so in its defects."""
    outcome = run_case("single", 202)
    assert "rows" in outcome.hidden["timing"]
    assert outcome.judgement.found == ("timing",)
    assert outcome.judgement.right
