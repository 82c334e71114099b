"""From a case to the columns of its recording."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from tests.hidden.foreign import effects as fx
from tests.hidden.foreign.bases import BASES, Array, displacement
from tests.hidden.foreign.drives import drive
from tests.hidden.foreign.noise import noise

#: Least rate of the grid on which the stage is simulated, Hz.
FINE_HZ = 16_000.0


@dataclass(frozen=True)
class Rig:
    """A stage with its electronics, and how it is driven and recorded.

    Attributes
    ----------
    base : a name of `bases.BASES`. used_before : full cycles went before the record.
    drive : a name of `drives.SHOWS`. noise : a name of `noise.KINDS`.
    fs_hz, duration_s : of the recording. span_V, stroke_um : full range of the drive (from 0 V) and of the stage.
    lag_s : the stage's own first-order lag, which the nominal stage has too.
    straight : the voltage runs linearly between samples; else it is held.
    early : how long before the next voltage the sensor is read, as a share of the sample time, below 1.
    sigma_um : standard deviation of the noise. offset_um : reading at rest.
    """

    seed: int
    base: str
    used_before: bool
    drive: str
    noise: str
    fs_hz: float
    duration_s: float
    span_V: float
    stroke_um: float
    lag_s: float
    straight: bool
    early: float
    sigma_um: float
    offset_um: float

    @property
    def n(self) -> int:
        """Number of samples."""
        return round(self.fs_hz * self.duration_s)

    @property
    def over(self) -> int:
        """Simulated steps per sample."""
        return max(4, int(np.ceil(FINE_HZ / self.fs_hz)))

    @property
    def early_steps(self) -> int:
        """`early` in simulated steps."""
        return int(self.early * self.over)


@dataclass(frozen=True)
class Case:
    """What is really there. ``effects``: cause to its numbers; ``sizes``: cause to the change of the reading in rms,
    as a share of the stroke (missing where the change is not one of values: lost rows)."""

    kind: str
    seed: int
    rig: Rig
    effects: dict[str, dict[str, float]] = field(default_factory=dict)
    sizes: dict[str, float] = field(default_factory=dict)

    @property
    def hidden(self) -> tuple[str, ...]:
        """Names that must be found."""
        return tuple(self.effects)

    @property
    def allowed(self) -> frozenset[str]:
        """Names that may stand beside the truth: the nominal stage is Bouc-Wen.

        Driven to one side only, the loops of three bases are not point-symmetric: asymmetry is a property of theirs.
        """
        if self.rig.base == "bouc_wen":
            return frozenset()
        bent = self.rig.base in ("preisach", "coleman_hodgdon", "jiles_atherton")
        return frozenset({"hysteresis_shape", "asymmetry"} if bent else {"hysteresis_shape"})

    def without(self, name: str) -> Case:
        """The same case with one effect less."""
        return replace(self, effects={key: value for key, value in self.effects.items() if key != name})

    def quiet(self) -> Case:
        """The same case without noise."""
        return replace(self, rig=replace(self.rig, sigma_um=0.0))


def _generator(seed: int, purpose: int) -> np.random.Generator:
    return np.random.default_rng([seed, 90 + purpose])


def _between_samples(x: Array, rig: Rig) -> Array:
    if not rig.straight:
        return np.repeat(x, rig.over)
    k = np.arange(x.size * rig.over) / rig.over
    return np.interp(k, np.arange(x.size), x)


def _static(x: Array, case: Case, fs: float) -> Array:
    """Displacement (share of the stroke) behind amplifier and actuator, on the fine grid."""
    rig, what = case.rig, case.effects
    span = rig.span_V
    u = span * x
    if "saturation" in what:
        own = what["saturation"]
        u = fx.saturation(u, own["top_V"], 1e-4 * span)
    if "slew_limit" in what:
        u = fx.slew_limit(u, what["slew_limit"]["rate_V_per_s"], fs)
    if "amplifier_lag" in what:
        u = fx.first_order(u, what["amplifier_lag"]["tau_s"], fs, held=not rig.straight and "slew_limit" not in what)
    x = u / span
    w, remains = displacement(rig.base, x, rig.used_before, _generator(rig.seed, 0))
    if "rate_dependence" in what:
        # A loop grows about its own middle, not about the point at which a record begins.
        own = what["rate_dependence"]
        w = fx.rate_dependence(x, w, own["per_decade"], own["corner_per_s"], fs)
    w = w - remains
    if "asymmetry" in what:
        own = what["asymmetry"]
        w = w + (fx.branch_curvature(x, own["share"]) if "share" in own else fx.dead_zone(w, own["knee"], own["slope"]))
    return w


def _mechanics(y: Array, case: Case, fs: float) -> Array:
    rig, what = case.rig, case.effects
    # A held voltage steps; what an amplifier has passed on is continuous, and so is what a lag has.
    held = not rig.straight and not {"amplifier_lag", "slew_limit"} & set(what)
    if rig.lag_s > 0.0:
        y = fx.first_order(y, rig.lag_s, fs, held)
    if "resonance" in what:
        own = what["resonance"]
        if "second_Hz" in own:
            share = own["second_share"]
            y = fx.modes(y, [own["f_Hz"], own["second_Hz"]], [own["damping"]] * 2, [1.0 - share, share], fs)
        else:
            y = fx.modes(y, [own["f_Hz"]], [own["damping"]], [1.0], fs)
    if "known_Hz" in what.get("payload_change", {}):
        own = what["payload_change"]
        start = round(own["from_share"] * y.size)
        y = fx.loaded_mode(y, own["known_Hz"], own["damping"], own["ratio"], start, fs, held and rig.lag_s == 0.0)
    if "delay" in what:
        y = fx.delayed(y, what["delay"]["tau_s"], fs)
    return y


def _other_axis(x2: Array, rig: Rig) -> Array:
    """Displacement of the other axis at the sample rate, µm."""
    w2 = BASES["play_sum"](x2, _generator(rig.seed, 1))
    return fx.first_order(0.9 * rig.stroke_um * w2, 2e-3, rig.fs_hz)


def record(case: Case) -> dict[str, Array]:
    """Columns of the recording, (n,) each: t_s, u_V, y_um, and u2_V, y2_um where the other axis is driven.

    Where rows are lost (timing "rows"), all columns are shorter by them.
    """
    rig, what = case.rig, case.effects
    n, fine = rig.n, rig.fs_hz * rig.over
    t = np.arange(n) / rig.fs_hz
    x, x2 = drive(rig.drive, n, rig.fs_hz, _generator(rig.seed, 2))
    y = _mechanics(rig.stroke_um * _static(_between_samples(x, rig), case, fine), case, fine)
    t_fine = np.arange(y.size) / fine
    if "creep" in what:
        own = what["creep"]
        y = y + np.interp(t_fine, t, fx.creep(y[:: rig.over], own["share"], own["power"], rig.fs_hz))
    y2 = _other_axis(x2, rig) if np.any(x2) else np.zeros(n)
    if "cross_talk" in what:
        own = what["cross_talk"]
        y = y + np.interp(t_fine, t, own["share"] * y2 + own["rate_s"] * np.gradient(y2) * rig.fs_hz)
    if "stick_slip" in what:
        y = fx.stick_slip(y, what["stick_slip"]["reach_um"])
    if "gain_drift" in what:
        y = y * (1.0 + fx.gain_drift(t_fine, what["gain_drift"]["total"]))
    if "thermal_drift" in what:
        y = y + fx.thermal_drift(t_fine, what["thermal_drift"]["total_um"], what["thermal_drift"]["tau_s"])
    if "sensor_nonlinearity" in what:
        y = y + fx.sensor_nonlinearity(y, what["sensor_nonlinearity"]["share"], rig.stroke_um)
    if "sensor_lag" in what:
        y = fx.first_order(y, what["sensor_lag"]["tau_s"], fine)
    stretch = 1.0 + 1e-6 * what.get("timing", {}).get("ppm", 0.0)
    read_at = np.clip(stretch * t - rig.early_steps / fine, 0.0, t_fine[-1])
    # Both sensors are read at once.
    y = rig.offset_um + np.interp(read_at, t_fine, y)
    own_noise = noise(rig.noise, n, 1.0 / rig.fs_hz, rig.sigma_um, _generator(rig.seed, 3))
    if "sensor_lag" in what:
        own_noise = fx.first_order(own_noise, what["sensor_lag"]["tau_s"], rig.fs_hz)
    y = y + own_noise
    if "mains_hum" in what:
        y = y + fx.mains_hum(t, what["mains_hum"]["f_Hz"], what["mains_hum"]["amplitude_um"])
    if "quantisation" in what:
        y = fx.quantisation(y, what["quantisation"]["step_um"])
    columns = {"t_s": t, "u_V": rig.span_V * x, "y_um": y}
    if np.any(x2):
        noise2 = noise("white", n, 1.0 / rig.fs_hz, rig.sigma_um, _generator(rig.seed, 4))
        columns |= {"u2_V": rig.span_V * x2, "y2_um": np.interp(read_at, t, y2) + noise2}
    return _with_timing(columns, case)


def _with_timing(columns: dict[str, Array], case: Case) -> dict[str, Array]:
    own, n = case.effects.get("timing", {}), case.rig.n
    rng = _generator(case.rig.seed, 5)
    if "slips" in own:
        moving = np.flatnonzero(np.abs(np.diff(columns["u_V"])) > 0.0)
        moving = moving[(moving > n // 20) & (moving < n - n // 20)]
        at = np.sort(rng.choice(moving, int(own["slips"]), replace=False)).astype(np.float64)
        # One sign: a recorder that loses samples does not double them as well.
        columns["y_um"] = fx.slips(columns["y_um"], at, np.full(at.size, own["sign"]))
    if "rows" in own:
        gone = rng.choice(np.arange(n // 20, n - n // 20), int(own["rows"]), replace=False)
        columns = {name: np.delete(values, gone) for name, values in columns.items()}
    return columns
