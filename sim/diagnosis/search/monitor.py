"""What a voltage monitor at the actuator says about the drive of a fitted model."""

from __future__ import annotations

import numpy as np

from adaptive.types import BoolArray, FloatArray
from sim.diagnosis.model.fit import Fit
from sim.diagnosis.search.noise_floor import standing


def drive_at_samples(fit: Fit) -> FloatArray:
    """The model's voltage at the actuator at the sampling instants, just before the next command acts."""
    drive = fit.signals.drive_V
    m = fit.model.substeps
    if fit.model.continuous:
        return np.ascontiguousarray(drive[::m])
    if m == 1:
        return np.concatenate([drive[:1], drive[:-1]])
    return np.concatenate([drive[:1], drive[m - 1 : -1 : m]])


def monitor_noise_V(fit: Fit) -> float:
    """Noise of the monitor: its spread while the drive stands still, at least what a 16-bit converter rounds."""
    setting = fit.model.setting
    assert setting.monitor_V is not None
    still = standing(setting, 0.1)
    d = np.diff(setting.monitor_V)[still[1:]]
    least = float(np.ptp(setting.monitor_V)) / 65536.0
    return max(float(np.std(d)) / np.sqrt(2.0) if d.size > 20 else 0.0, least)


def monitor_misfit(fit: Fit, mask: BoolArray) -> float:
    """Squared error of the monitor, in units of its noise; gain, offset and latch of the monitor are free.

    Zero without a monitor. Some amplifiers' monitors lag a sample: the better of the two alignments counts.
    """
    setting = fit.model.setting
    if setting.monitor_V is None:
        return 0.0
    seen = setting.monitor_V
    best = np.inf
    for drive in (drive_at_samples(fit), np.roll(drive_at_samples(fit), -1)):
        x, y = drive[mask], seen[mask]
        columns = np.stack([x, np.ones_like(x)])
        solved = np.linalg.lstsq(columns.T, y, rcond=None)[0]
        best = min(best, float(np.sum(np.square(y - solved @ columns))))
    return best / monitor_noise_V(fit) ** 2
