"""Where the remaining error of a diagnosed recording lies: in time, frequency, position and direction."""

from __future__ import annotations

import numpy as np

from adaptive.types import BoolArray
from sim.diagnosis.model.calibration import ModelFit


def where_left(fit: ModelFit, mask: BoolArray, sigma_um: float) -> tuple[str, ...]:
    """Sentences that locate the residual of ``fit`` where it stands above the noise ``sigma_um`` (µm)."""
    data, r = fit.model.data, np.where(mask, fit.residual_um, 0.0)
    total = float(np.sum(r**2))
    if total <= 1.2 * sigma_um**2 * float(mask.sum()):
        return ()
    out = []
    block = max(8, round(0.05 / data.dt_s))
    count = data.n // block
    energy = np.sum(r[: count * block].reshape(count, block) ** 2, axis=1)
    order = np.argsort(energy)[::-1]
    half = int(np.searchsorted(np.cumsum(energy[order]), 0.5 * total)) + 1
    if half <= 0.05 * count:
        first = ", ".join(f"{i * block * data.dt_s:.4g} s" for i in sorted(order[: min(half, 4)]))
        out.append(f"time: half of it lies in {100 * half / count:.2g} % of the record, about {first}")
    else:
        out.append("time: it is spread over the record")
    f, power = np.fft.rfftfreq(data.n, data.dt_s), np.abs(np.fft.rfft(r)) ** 2
    share = np.cumsum(power) / max(float(power.sum()), 1e-300)
    low, high = (float(f[int(np.searchsorted(share, q))]) for q in (0.1, 0.9))
    out.append(f"frequency: four fifths of it lie from {low:.3g} to {high:.3g} Hz")
    moving = data.rate_V_per_s > 1e-6 * data.swing_V / data.dt_s
    rising = moving & (np.diff(data.u_V, prepend=data.u_V[0]) > 0.0)
    groups = {"rising": rising & mask, "falling": moving & ~rising & mask, "at rest": ~moving & mask}
    sizes = {k: float(np.sqrt(np.mean(r[m] ** 2))) for k, m in groups.items() if int(m.sum()) > 50}
    out.append("direction: " + ", ".join(f"{1e3 * v:.3g} nm {k}" for k, v in sizes.items()))
    edges = np.linspace(data.u_low_V, data.u_high_V, 5)
    at = np.clip(np.searchsorted(edges, data.u_V) - 1, 0, 3)
    thirds = [
        f"{1e3 * float(np.sqrt(np.mean(r[(at == i) & mask] ** 2))):.3g} nm from {edges[i]:.3g} V"
        for i in range(4)
        if int(((at == i) & mask).sum()) > 50
    ]
    out.append("position: " + ", ".join(thirds))
    return tuple(out)
