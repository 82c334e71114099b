"""Move the stage of my_stage.py along a trajectory, once by its mean gain and once by the served inverse model.

    python examples/corrected_move.py             # beside `dehyst serve`

Both runs publish their samples, so the service learns from them. The second follows the model into this process and
takes its hysteresis memory anew from the measured samples four times a second.
"""

import numpy as np
from my_stage import RATE_HZ, open_stage

from service.adapters import StageLoop
from service.client import Client

SECONDS, RESYNCHRONISE_EVERY = 8, int(RATE_HZ / 4)


def trajectory(low_um: float, high_um: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(y µm, v µm/s, a µm/s²) of a sine of 0.5 Hz over the range that begins at rest at its lower end."""
    t, w, half = np.arange(int(SECONDS * RATE_HZ)) / RATE_HZ, 2 * np.pi * 0.5, (high_um - low_um) / 2
    return low_um + half * (1 - np.cos(w * t)), half * w * np.sin(w * t), half * w**2 * np.cos(w * t)


def report(name: str, y_um: np.ndarray, measured_um: np.ndarray) -> None:
    """Print the error of a run, without its first second, in which the stage comes to the trajectory."""
    error = (measured_um - y_um)[int(RATE_HZ) :]
    span = np.ptp(y_um)
    print(f"{name}: mean error {np.abs(error).mean():.3f} µm ({100 * np.abs(error).mean() / span:.2f} % of "
          f"{span:.0f} µm), largest {np.abs(error).max():.3f} µm")  # fmt: skip


def run(name: str, stage, client: Client, y_um: np.ndarray, voltage) -> None:
    """One run of the trajectory; `voltage(i, loop, seq)` gives the voltage of its point i."""
    loop = StageLoop(stage, client)
    client.reference(loop.first, y_um)  # the wanted motion, for viewer and diagnosis
    summary = loop.run(lambda seq, _: voltage(seq - loop.first, loop, seq), samples=y_um.size)
    seq, _, measured_um = loop.measured(loop.first)
    report(name, y_um[seq - loop.first], measured_um)
    if summary.late or summary.lost:
        print(f"  {summary.late} of {y_um.size} samples came late and were left out, {summary.lost} were lost")


with open_stage() as stage, Client.connect("tcp/127.0.0.1:7447", stage="demo", axis="x", wait_s=10.0) as client:
    limits = client.limits
    low_um, high_um = np.interp([0.2, 0.8], [0, 1], [max(limits.y_min_um, 0.0), limits.y_max_um])
    y_um, v_um_per_s, a_um_per_s2 = trajectory(low_um, high_um)

    line_V = [client.point(end_um, model="linear").u_V for end_um in (low_um, high_um)]
    mean_gain_V = np.interp(y_um, [low_um, high_um], line_V)
    run("mean gain ", stage, client, y_um, lambda i, loop, seq: mean_gain_V[i])

    follower = client.follow()
    follower.point(low_um)  # compiles what the loop needs

    def corrected(i: int, loop: StageLoop, seq: int) -> float:
        if i and i % RESYNCHRONISE_EVERY == 0:
            follower.resynchronise(*loop.measured(follower.snapshot_seq - 1))
        return follower.point(y_um[i], v_um_per_s[i], a_um_per_s2[i])

    run("corrected ", stage, client, y_um, corrected)
    print("status:", client.status()["trouble"] or "no trouble", "- snapshots received:", follower.received)
