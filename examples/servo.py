"""A servo that is there already, and the model added to its output: a PI controller on a simulated stage.

    dehyst stage --examples files && dehyst identify files/recording.csv --out stage.npz
    python servo.py stage.npz servo.png

The servo alone follows a sine for a second; then the model is switched on, without a step of the voltage.
"""

import sys

import numpy as np

from dehyst.service.storage.model_file import read_bundle
from dehyst.sim.stage.presets import preset
from dehyst.sim.stage.stage import Stage

U_MIN_V, U_MAX_V = 0.0, 8.0
P_V_PER_UM, I_V_PER_UM_S = 0.01, 20.0  # the servo as it is: the mode at 450 Hz allows 27
FREQUENCY_HZ, SECONDS, ON_S = 5.0, 2.0, 1.0


class Servo:
    """A PI controller of the position, with the voltage of the model added behind it."""

    def __init__(self, dt_s):
        self.dt_s, self.integral_V, self.u_V, self.added_V = dt_s, 0.0, 0.0, 0.0

    def step(self, wanted_um, read_um, model_V, p_V_per_um=P_V_PER_UM):
        """The voltage to apply, V; ``wanted_um`` is that of the sample at which ``read_um`` was read."""
        error_um = wanted_um - read_um
        p_V = p_V_per_um * error_um
        if (model_V == 0.0) != (self.added_V == 0.0):  # switched on or off: the sum is the voltage that is applied now
            self.integral_V = self.u_V - p_V - model_V
        self.added_V = model_V
        total_V = p_V + self.integral_V + model_V
        self.u_V = min(max(total_V, U_MIN_V), U_MAX_V)
        if self.u_V == total_V:  # at a limit the integral stands still
            self.integral_V += I_V_PER_UM_S * error_um * self.dt_s
        return self.u_V


def run(path):
    """(time, s; wanted and read displacement, µm; voltage, V), (n,) each."""
    model = read_bundle(path).models["lssvm_adaptive"]
    t_s = np.arange(round(SECONDS / model.dt_s)) * model.dt_s
    w = 2 * np.pi * FREQUENCY_HZ
    wanted_um = 45.0 - 25.0 * np.cos(w * t_s)
    v_um_per_s, a_um_per_s2 = 25.0 * w * np.sin(w * t_s), 25.0 * w**2 * np.cos(w * t_s)
    model_V = model.feedforward(wanted_um, v_um_per_s, a_um_per_s2, model.rest_memory(wanted_um[0])).u_V
    stage, servo = Stage(preset("rich", seed=4, dt_s=model.dt_s)), Servo(model.dt_s)
    state, read_um, u_V = stage.initial_state(), np.empty(t_s.size), np.empty(t_s.size)
    for k in range(t_s.size - 1):
        read_um[k] = stage.step(state, servo.u_V)[0]
        # What is computed now is applied at the next sample.
        u_V[k] = servo.step(wanted_um[k], read_um[k], model_V[k + 1] if t_s[k] >= ON_S else 0.0)
    return t_s[:-1], wanted_um[:-1], read_um[:-1], u_V[:-1]


def draw(path, t_s, wanted_um, read_um, u_V):
    """Wanted and read displacement, the error, and the voltage."""
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(3, 1, figsize=(9.0, 6.5), sharex=True, layout="constrained")
    axes[0].plot(t_s, wanted_um, t_s, read_um)
    axes[0].legend(["wanted", "read"], loc="upper right")
    axes[0].set_ylabel("displacement / µm")
    axes[1].plot(t_s, wanted_um - read_um)
    axes[1].set_ylabel("error / µm")
    axes[2].plot(t_s, u_V)
    axes[2].set_ylabel("voltage / V")
    axes[2].set_xlabel("time / s")
    for one in axes:
        one.axvline(ON_S, color="0.5", linestyle=":")
    figure.savefig(path, dpi=110)


if __name__ == "__main__":
    t_s, wanted_um, read_um, u_V = run(sys.argv[1])
    for name, part in (("servo alone", (t_s > 0.4) & (t_s < ON_S)), ("with the model", t_s > ON_S + 0.4)):
        error_um = np.abs(wanted_um - read_um)[part]
        print(f"{name}: mean error {error_um.mean():.3f} µm, largest {error_um.max():.3f} µm")
    at = np.searchsorted(t_s, ON_S)
    print(f"step of the voltage at the switch: {abs(u_V[at] - u_V[at - 1]):.4f} V")
    if len(sys.argv) > 2:
        draw(sys.argv[2], t_s, wanted_um, read_um, u_V)
