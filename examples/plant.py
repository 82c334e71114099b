"""A stage of one's own, for ``dehyst rehearse --plant examples/plant.py:Stage``.

A plant has three numbers and one method. It begins at rest, with the voltage of its drive that is nearest to zero.
Reading k is taken at the instant at which voltage k begins to be applied.
"""

import numpy as np


class Stage:
    """Twelve play operators, a mode at 320 Hz and 4 nm of noise; 60 µm over 0 to 100 V, 1000 samples a second."""

    dt_s = 0.001  # sample time, s
    u_min_V, u_max_V = 0.0, 100.0  # limits of the drive, V

    def __init__(self) -> None:
        self.radius_V = np.linspace(0.0, 40.0, 12)
        self.weight = 0.6 * np.exp(-np.arange(12.0)) / np.exp(-np.arange(12.0)).sum()  # µm/V
        self.play_V = np.zeros(12)
        self.y_um = self.v_um_per_s = 0.0
        self.noise = np.random.default_rng(1)

    def run(self, u_V: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(true displacement, reading of the sensor), both (n,) µm, under (n,) voltages."""
        true_um, step_s = np.empty(len(u_V)), self.dt_s / 20
        for k, u in enumerate(u_V):
            true_um[k] = self.y_um
            self.play_V = np.clip(self.play_V, u - self.radius_V, u + self.radius_V)
            target_um, omega = self.weight @ self.play_V, 2 * np.pi * 320.0
            for _ in range(20):
                pull = omega**2 * (target_um - self.y_um) - 2 * 0.05 * omega * self.v_um_per_s
                self.v_um_per_s += step_s * pull
                self.y_um += step_s * self.v_um_per_s
        return true_um, true_um + 0.004 * self.noise.standard_normal(len(u_V))
