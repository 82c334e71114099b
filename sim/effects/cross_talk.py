"""Cross-talk: a share of the other axis's displacement and velocity appears on this one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from sim.effects.base import Context, Kind, Parameter, Place, block


@block
def run(p: Any, s: Any, x: Any, v: Any, w: Any, n: int, k0: int) -> None:
    """p: static share, weight of a change. s: the other axis so far, µm, and whether it is known."""
    for k in range(n):
        if s[1] == 0.0:
            s[0], s[1] = w[k], 1.0
        x[k] += p[0] * w[k] + p[1] * (w[k] - s[0])
        s[0] = w[k]


def derive(values: Mapping[str, float], context: Context) -> Sequence[float]:
    return values["static"], values["rate_s"] / context.dt_s


KIND = Kind(
    name="cross_talk",
    place=Place.CROSS_TALK,
    parameters=(
        Parameter("static", "1", -0.2, 0.2, 0.0117, "share of the other axis's displacement"),
        Parameter("rate_s", "s", -0.01, 0.01, 0.0, "share of the other axis's velocity"),
    ),
    derive=derive,
    rest=lambda values, context: (0.0, 0.0),
    block=run,
    signature="correlates with the other axis",
    tells_apart="drive the axes separately",
    source="1.17 % in the chapter (Fig. 2.2); 0.01 to 1 % in the field",
)
