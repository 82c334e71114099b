"""Smoother, hysteresis memory and model inputs of many axes at once, as operations of torch.

The single learner's forms are ``adaptive.smoothing`` and ``adaptive.features``; the arithmetic is the same.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from adaptive.fleet.state import AxisConstants, BatchState


def advance(c: AxisConstants, y_um: Tensor, memory: Tensor, gain: Tensor, offset_um: Tensor) -> Tensor:
    """(B, m) memory after a point at ``y_um`` (B,), in frames (B,); see `adaptive.features.advance`."""
    K, A = c.sizes["K"], c.sizes["A"]
    y = ((y_um - offset_um) * (1.0 / gain))[:, None]
    plays = torch.maximum(y - c.thresholds, torch.minimum(y + c.thresholds, memory[:, :K]))
    slow_end = K + A + c.retain.shape[1]
    slow = y + (memory[:, K + A : slow_end] - y) * c.retain
    if A == 0:
        return torch.cat((plays, slow), 1)
    end = memory[:, -1:]
    dead = c.dead_um[:, None]
    moved = torch.maximum(y - dead, torch.minimum(y + dead, end))
    arcs = y + (memory[:, K : K + A] - y) * torch.exp(-(moved - end).abs() / c.arcs)
    return torch.cat((plays, arcs, slow, moved), 1)


def inputs(
    c: AxisConstants, axes: Tensor, motion: Tensor, memory: Tensor, gain: Tensor, offset_um: Tensor
) -> tuple[Tensor, Tensor]:
    """Basis (k, p) and kernel inputs (k, d) of ``axes`` (k,) with ``motion`` (k, 3); see `adaptive.features.fill`."""
    K, A = c.sizes["K"], c.sizes["A"]
    r, scale, inverse = c.thresholds[axes], c.scale[axes], 1.0 / gain
    y = (motion[:, 0] - offset_um) * inverse
    yn, vn = (y - scale[:, 0]) * scale[:, 1], motion[:, 1] * inverse * scale[:, 2]
    plays = (y[:, None] - memory[:, :K]) / r if K else memory[:, :0]
    kernel = torch.cat((yn[:, None], vn[:, None], plays[:, c.plays]), 1)
    one = torch.ones_like(yn)
    if not c.flags[0]:
        return one[:, None], kernel
    first = torch.stack((one, yn, vn, motion[:, 2] * inverse * scale[:, 3], yn * yn, yn * yn * yn), 1)
    parts = [first, plays]
    if c.flags[1]:
        parts.append(plays * yn[:, None])
    parts.append((y[:, None] - memory[:, K : K + A]) / c.arcs[axes])
    slow_end = K + A + c.retain.shape[1]
    parts.append((y[:, None] - memory[:, K + A : slow_end]) * scale[:, 1:2])
    return torch.cat(parts, 1), kernel


class Instant(NamedTuple):
    """A step of the smoother of all axes, before it is written: what changes, and the pair to learn (see `Pair`)."""

    x: Tensor
    row: Tensor
    motion: Tensor
    memory: Tensor
    frozen_memory: Tensor
    now: Tensor
    u_V: Tensor
    u_before_V: Tensor
    good: Tensor
    near_bad: Tensor


class Smoothing:
    """The smoother's constants on the device."""

    def __init__(self, c: AxisConstants) -> None:
        s, device = c.smoother, c.span_V.device
        self._c = c
        self._transition, self._gain, self._gains, self._scale = (
            torch.as_tensor(part.copy()).to(device) for part in (s.transition, s.gain, s.lag_gains, s.scale)
        )
        self._back = torch.arange(s.config.lag, device=device)

    def step(self, s: BatchState, y_um: Tensor) -> Instant:
        """A reading of every axis, (B,) µm. Nothing is written."""
        c, x, ring = self._c, s["front.track.smoother.x"], s["front.track.smoother.ring"]
        count, depth = s["front.track.smoother.count"], ring.shape[1]
        lag, slots = depth - 1, depth + 1
        innovation = y_um - x[:, 0]
        row = torch.cat((innovation[:, None], x[:, :3]), 1)
        after = (x + innovation[:, None] * self._gain) @ self._transition.T
        old = (count + 1) % depth
        past = ring[:, :, 0].gather(1, (old[:, None] + self._back) % depth)
        begun = ring.gather(1, old[:, None, None].expand(-1, 1, 4))[:, 0, 1:]
        motion = (begun + past @ self._gains[:lag] + innovation[:, None] * self._gains[lag]) * self._scale
        now = count - lag
        at, before = (now % slots)[:, None], ((now - 1) % slots)[:, None]
        gain, offset = s["front.track.served.gain"], s["front.track.served.offset_um"]
        good = s["front.track.good"].scatter(1, (count % slots)[:, None], True)
        voltages = s["front.track.u_V"]
        clean = good.all(1)
        return Instant(
            after, row, motion,
            advance(c, motion[:, 0], s["front.track.memory"], gain, offset),
            advance(c, motion[:, 0], s["front.track.frozen_memory"], c.frame[:, 0], c.frame[:, 1]),
            now, voltages.gather(1, at)[:, 0], voltages.gather(1, before)[:, 0],
            clean | (good.gather(1, at) & good.gather(1, before))[:, 0], ~clean,
        )  # fmt: skip

    def write(self, s: BatchState, axes: Tensor, instant: Instant, u_V: Tensor, y_um: Tensor) -> None:
        """Write the step of ``axes`` (k,)."""
        count = s["front.track.smoother.count"][axes]
        depth = s["front.track.smoother.ring"].shape[1]
        slot = count % (depth + 1)
        s["front.track.smoother.x"][axes] = instant.x[axes]
        s["front.track.smoother.ring"][axes, count % depth] = instant.row[axes]
        s["front.track.smoother.count"][axes] = count + 1
        s["front.track.u_V"][axes, slot] = u_V[axes]
        s["front.track.y_um"][axes, slot] = y_um[axes]
        s["front.track.good"][axes, slot] = True
        s["front.track.motion"][axes] = instant.motion[axes]
        s["front.track.memory"][axes] = instant.memory[axes]
        s["front.track.frozen_memory"][axes] = instant.frozen_memory[axes]


def memory_now(c: AxisConstants, s: BatchState, frozen: bool) -> Tensor:
    """(B, m) memory at the last reading: the smoothed one, carried along the readings since."""
    lag, slots = c.sizes["lag"], c.sizes["lag"] + 2
    memory = s["front.track.frozen_memory" if frozen else "front.track.memory"]
    gain = c.frame[:, 0] if frozen else s["front.track.served.gain"]
    offset = c.frame[:, 1] if frozen else s["front.track.served.offset_um"]
    count = s["front.track.smoother.count"]
    for k in range(lag):
        reading = s["front.track.y_um"].gather(1, ((count - lag + k) % slots)[:, None])[:, 0]
        memory = advance(c, reading, memory, gain, offset)
    return memory
