"""Move the stage along a sine, by its mean gain and by the served inverse model; the service learns from both."""

import numpy as np
from my_stage import RATE_HZ, open_stage

from dehyst import Client
from dehyst.service.adapters import StageLoop

SECONDS, FREQUENCY_HZ, RESYNCHRONISE_S = 10, 0.5, 0.25


def move(name, stage, client, y_um, voltage):
    """One run along y_um; voltage(i, loop) gives the voltage of point i. Prints the error after the first second."""
    loop = StageLoop(stage, client)
    client.reference(loop.first, y_um)  # the wanted motion, for the viewer
    summary = loop.run(lambda seq, reading_um: voltage(seq - loop.first, loop), samples=len(y_um))
    seq, _, reading_um = loop.measured(loop.first + int(RATE_HZ))
    error_um = np.abs(reading_um - y_um[seq - loop.first])
    print(f"{name}: mean error {error_um.mean():.3f} µm, {100 * error_um.mean() / np.ptp(y_um):.2f} % of the motion, "
          f"largest {error_um.max():.3f} µm; {summary.late} of {len(y_um)} samples came late")  # fmt: skip


with open_stage() as stage, Client.connect("tcp/127.0.0.1:7447", stage="demo", axis="x", wait_s=10.0) as client:
    low_um, high_um = 0.2 * client.limits.y_max_um, 0.8 * client.limits.y_max_um
    t, w, half_um = np.arange(SECONDS * RATE_HZ) / RATE_HZ, 2 * np.pi * FREQUENCY_HZ, (high_um - low_um) / 2
    y_um = low_um + half_um * (1 - np.cos(w * t))
    v_um_per_s, a_um_per_s2 = half_um * w * np.sin(w * t), half_um * w**2 * np.cos(w * t)

    ends_V = [client.point(end_um, model="linear").u_V for end_um in (low_um, high_um)]
    mean_gain_V = np.interp(y_um, [low_um, high_um], ends_V)
    move("mean gain", stage, client, y_um, lambda i, loop: mean_gain_V[i])

    follower = client.follow()  # the model, evaluated in this process; it is renewed while the service learns
    follower.point(low_um)  # compiles what the loop needs

    def corrected(i, loop):
        if i % int(RESYNCHRONISE_S * RATE_HZ) == 1:  # where the stage really is, from the samples
            follower.resynchronise(*loop.measured(follower.snapshot_seq - 1))
        return follower.point(y_um[i], v_um_per_s[i], a_um_per_s2[i])

    move("corrected", stage, client, y_um, corrected)
