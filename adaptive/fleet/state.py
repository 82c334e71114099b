"""The state of a fleet: the entries of a single learner's state, with one row for each axis, as tensors.

An axis is kept here while its learner is *ordinary* (`Parts.ordinary`): readings are trusted and nothing is in doubt.
Names, shapes and meaning are those of ``Learner.state_dict``, so that an axis moves between a fleet and a single
learner by its checkpoint. What an ordinary step neither reads nor writes stays with the axis as it came.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import torch
from torch import Tensor

from adaptive.errors import InputError
from adaptive.fleet.config import FleetConfig
from adaptive.inverse_model import LssvmInverse
from adaptive.online.dead_reckoning import answers, drive_V, mean_slope
from adaptive.online.drift import FAST_S, SLOW_S
from adaptive.online.gates import LEARNT, PASSED, REASONS
from adaptive.online.glitch_or_jump import MOST_BRIDGED
from adaptive.online.learner import Learner
from adaptive.smoothing import FixedLagSmoother
from adaptive.types import IntArray, StateDict

#: Results of a sample, by their number in a fleet.
OUTCOMES: Final = (LEARNT, PASSED, *REASONS)

_FRAME: Final = "front.track.served."
_FLOATS: Final = (
    *(f"front.gates.{name}" for name in ("t_s", "anchor_um", "u_V", "u_before_V", "kink_V", "innovation2", "y_um")),
    "front.gates.low_V", "front.gates.high_V", f"{_FRAME}gain", f"{_FRAME}offset_um",
    *(f"front.following.{name}" for name in ("u_V", "p_V", "count", "driven", "uu", "pp", "up", "last_V", "noise2")),
    "rest.constant_V", "rest.u_V", "rail_s", "left_s",
    *(f"judgement.{name}" for name in ("long_V2", "short_V2", "frozen_V2", "frozen_short_V2", "error_V", "fallen_s")),
    "judgement.doubt_V2", "window.kernel_variance",
)  # fmt: skip
_INTEGERS: Final = (
    *(f"front.gates.{name}" for name in ("seq", "since_start", "since_jump", "since_step", "since_glitch", "moved")),
    "front.gates.same", "front.track.smoother.count", "front.track.switch",
    *(f"front.following.{name}" for name in ("steps", "good", "still")),
    "front.calm", "front.credit", "front.until_control", "front.look_from", "rest.steps",
    "judgement.judged", "judgement.inside", "window.clock", "window.changed", "window.next", "events.fallbacks",
)  # fmt: skip
_TRUTHS: Final = ("judgement.valid", "judgement.fallback", "frozen")
#: Entries whose columns are scalars of the single learner's state.
_PACKED: Final = {
    "filter.squares": ("filter.fast_V2", "filter.slow_V2"),
    "filter.counts": ("filter.rejected", "filter.quiet", "filter.bursts", "filter.updates"),
    "counters": tuple(f"counters.{name}" for name in OUTCOMES),
}
#: Marks of the filter that an ordinary step reads or writes.
MARKS: Final = ("mark", "next_mark", "confirmed0", "confirmed1")
#: Parts of a past place, in the order of `adaptive.online.track.Past`.
PAST: Final = ("motion", "u_before_V", "lag_V", "lag_um", "memory")


@dataclass(frozen=True)
class AxisConstants:
    """What does not change, as tensors with one row for each of B axes; those of M distinct models have M rows.

    Attributes
    ----------
    bases : the identified models. smoother : of all axes. delay : steps of the filter between learning and serving.
    thresholds (B, K), arcs (B, A), retain (B, M), scale (B, 4), dead_um (B,), frame (B, 2) gain and offset : of the
    identified feature maps. plays : those that the kernel sees.
    """

    config: FleetConfig
    bases: tuple[LssvmInverse, ...]
    smoother: FixedLagSmoother
    step_s: float
    check_every: int
    delay: int
    sizes: dict[str, int]
    model_of: Tensor
    model_beta: Tensor
    model_scaled: Tensor
    model_alpha: Tensor
    model_inverse_widths: Tensor
    thresholds: Tensor
    arcs: Tensor
    retain: Tensor
    scale: Tensor
    dead_um: Tensor
    frame: Tensor
    plays: Tensor
    flags: tuple[bool, bool]
    middle_um: Tensor
    range_um: Tensor
    span_V: Tensor
    drive_V: Tensor
    slope_V_per_um: Tensor
    tells: Tensor
    allowed_V: Tensor
    beta: Tensor
    walk_V2: Tensor
    burst_V2: Tensor
    drift_limits: Tensor

    @property
    def axes(self) -> int:
        """B."""
        return len(self.bases)

    @property
    def dt_s(self) -> float:
        """Sample time, s."""
        return self.bases[0].dt_s


def distinct(bases: Sequence[LssvmInverse]) -> tuple[IntArray, list[int]]:
    """(B,) number of the distinct model of each axis, frames aside, and the first axis of each of them."""
    found: dict[tuple[object, ...], int] = {}
    firsts: list[int] = []
    numbers = np.zeros(len(bases), dtype=np.int64)
    for i, base in enumerate(bases):
        arrays = (base.beta, base.support, base.alpha, base.widths, base.beta_covariance)
        key = (*(array.tobytes() for array in arrays), base.gamma, base.span_V, base.kernel_variance)
        if key not in found:
            found[key] = len(firsts)
            firsts.append(i)
        numbers[i] = found[key]
    return numbers, firsts


def check_alike(bases: Sequence[LssvmInverse]) -> None:
    """Raise InputError naming the first axis whose model has another shape than that of axis 0."""
    if not bases:
        raise InputError("models: got none, expected one for each axis")
    for i, base in enumerate(bases):
        f, g = base.features, bases[0].features
        for name, got, expected in (
            ("dt_s", f.dt_s, g.dt_s),
            ("inputs", (f.basis_size, f.kernel_size, f.memory_size), (g.basis_size, g.kernel_size, g.memory_size)),
            ("kernel_plays", f.kernel_plays, g.kernel_plays),
            ("linear, asymmetric", (f.linear, f.asymmetric), (g.linear, g.asymmetric)),
        ):
            if got != expected:
                raise InputError(f"models[{i}].{name}: got {got}, expected {expected} as of axis 0; identify all alike")


def constants_of(
    bases: Sequence[LssvmInverse], config: FleetConfig, templates: Sequence[Learner], model_of: IntArray
) -> AxisConstants:
    """The constants of a fleet; ``templates`` : a learner of each distinct model, ``model_of`` (B,) : whose it is."""
    device, c = torch.device(config.device), config.learner
    parts, f = templates[0].parts, bases[0].features

    def rows(values: object) -> Tensor:
        return torch.as_tensor(np.array(values, dtype=np.float64)).to(device)

    models = [template.base for template in templates]
    most = max(1, *(model.alpha.size for model in models))
    scaled, alpha = np.full((len(models), f.kernel_size, most), 1e9), np.zeros((len(models), most))
    for m, model in enumerate(models):
        n = model.alpha.size
        scaled[m, :, :n], alpha[m, :n] = (model.support / model.widths).T, model.alpha
    step_s, drift = parts.filter.step_s, c.drift
    limits = [
        drift.gain_walk**2 * step_s, drift.burst_gain**2, drift.noise, drift.burst_floor, drift.burst_ratio,
        drift.gate_sigma**2, drift.gate_persistence, min(1.0, step_s / FAST_S), min(1.0, step_s / SLOW_S), step_s,
    ]  # fmt: skip
    shapes = [base.features.arrays for base in bases]
    variances = [template.parts.filter.variances for template in templates]
    reach = [template.parts.allowed_V - c.envelope.shape * drive_V(template.base) for template in templates]
    sizes = {
        "p": f.basis_size, "d": f.kernel_size, "m": f.memory_size, "K": len(f.thresholds_um),
        "A": len(f.arc_lengths_um), "N": c.window, "lag": parts.intake.smoother.config.lag,
        "order": parts.intake.smoother.config.order,
    }  # fmt: skip
    return AxisConstants(
        config=config, bases=tuple(bases), smoother=parts.intake.smoother, step_s=step_s,
        check_every=parts.check_every, delay=parts.delay.steps, sizes=sizes,
        model_of=torch.as_tensor(model_of).to(device), model_beta=rows([m.beta for m in models]),
        model_scaled=rows(scaled), model_alpha=rows(alpha), model_inverse_widths=rows([1.0 / m.widths for m in models]),
        thresholds=rows([a.thresholds for a in shapes]), arcs=rows([a.arcs for a in shapes]),
        retain=rows([a.retain for a in shapes]), scale=rows([a.scale for a in shapes]),
        dead_um=rows([base.features.dead_um for base in bases]),
        frame=rows([(base.features.gain, base.features.offset_um) for base in bases]),
        plays=torch.as_tensor(f.arrays.kernel_plays.copy()).to(device), flags=(f.linear, f.asymmetric),
        middle_um=rows([0.5 * (b.features.y_max_um + b.features.y_min_um) for b in bases]),
        range_um=rows([b.features.y_max_um - b.features.y_min_um for b in bases]),
        span_V=rows([base.span_V for base in bases]), drive_V=rows([drive_V(base) for base in bases]),
        slope_V_per_um=rows([mean_slope(base) for base in bases]),
        tells=rows([answers(base) for base in bases]) > 0.0,
        allowed_V=rows([c.envelope.shape * drive_V(b) + reach[m] if f.linear else 0.0
                        for b, m in zip(bases, model_of, strict=True)]),
        beta=rows([base.beta for base in bases]), walk_V2=rows([variances[m][0] for m in model_of]),
        burst_V2=rows([variances[m][1] for m in model_of]), drift_limits=rows(limits),
    )  # fmt: skip


class BatchState:
    """Tensors by name. Besides the single learner's entries:

    - ``delay`` (B, D, p), ``delay.count`` : ring of past estimates of the filter, and how many it has taken.
    - ``past.NAME`` (B, 2, ...), ``past.count`` : known places of the stage, the older one first; ``past.voltages`` :
      ring of all voltages, ``past.written`` : how many were written, ``past.from`` (B, 2) : how many before each place.
    - ``confirmed`` : whether the last check has confirmed that the readings follow the drive.
    """

    def __init__(self, c: AxisConstants) -> None:
        B, s, device = c.axes, c.sizes, torch.device(c.config.device)
        p, m, lag = s["p"], s["m"], s["lag"]
        floats: dict[str, tuple[int, ...]] = dict.fromkeys(_FLOATS, ()) | {
            "front.track.smoother.x": (s["order"],), "front.track.smoother.ring": (lag + 1, 4),
            "front.track.u_V": (lag + 2,), "front.track.y_um": (lag + 2,), "front.track.motion": (3,),
            "front.track.memory": (m,), "front.track.frozen_memory": (m,), "filter.beta": (p,),
            "filter.covariance": (p, p), "filter.squares": (2,), "domain": (6,), "point": (s["d"],),
            "window.own_weights": (s["N"],), "delay": (c.delay + 1, p), "past.motion": (2, 3), "past.u_before_V": (2,),
            "past.lag_V": (2, lag), "past.lag_um": (2, lag), "past.memory": (2, m),
            "past.voltages": (MOST_BRIDGED + 2,),
            **{f"{mark}.beta": (p,) for mark in MARKS}, **{f"{mark}.covariance": (p, p) for mark in MARKS},
        }  # fmt: skip
        integers: dict[str, tuple[int, ...]] = dict.fromkeys(_INTEGERS, ()) | {
            "window.born": (s["N"],), "filter.counts": (4,), "counters": (len(OUTCOMES),), "mark_ages": (2,),
            "confirmed_ages": (2,), "delay.count": (), "past.count": (), "past.written": (), "past.from": (2,),
        }  # fmt: skip
        truths = dict.fromkeys(_TRUTHS, ()) | {"front.track.good": (lag + 2,), "confirmed": ()}
        self._tensors: dict[str, Tensor] = {}
        for shapes, kind in ((floats, torch.float64), (integers, torch.int64), (truths, torch.bool)):
            for name, shape in shapes.items():
                self._tensors[name] = torch.zeros((B, *shape), dtype=kind, device=device)
        self._rest: list[StateDict] = [{} for _ in range(B)]
        self._plain = [name for name in self._tensors if not name.startswith(("delay", "past.", "confirmed"))]
        self._plain = [name for name in self._plain if name not in _PACKED] + ["confirmed0.beta", "confirmed1.beta"]
        self._plain += ["confirmed0.covariance", "confirmed1.covariance", "confirmed_ages"]

    def __getitem__(self, name: str) -> Tensor:
        return self._tensors[name]

    @property
    def bytes(self) -> int:
        """Size of all tensors, bytes."""
        return sum(tensor.numel() * tensor.element_size() for tensor in self._tensors.values())

    def load(self, axis: int, state: StateDict) -> None:
        """Take the state of an ordinary learner, without the arrays of its window. Raises KeyError, ValueError."""
        rest = dict(state)
        t = self._tensors
        for name in self._plain:
            self._write(name, axis, rest.pop(name))
        for name, columns in _PACKED.items():
            self._write(name, axis, np.array([rest.pop(column) for column in columns]))
        delay = np.asarray(rest.pop("delay"), dtype=np.float64).reshape(-1, t["delay"].shape[2])
        t["delay"][axis, : len(delay)] = torch.from_numpy(delay)
        t["delay.count"][axis] = len(delay)
        pasts = sorted({name.split(".")[1] for name in rest if name.startswith("front.past")})
        t["past.count"][axis], t["past.written"][axis] = len(pasts), 0
        voltages = [np.asarray(rest.pop(f"front.{past}.u_V")) for past in pasts]
        for j, past in enumerate(pasts):
            for name in PAST:
                value = np.asarray(rest.pop(f"front.{past}.{name}"), dtype=np.float64)
                t[f"past.{name}"][axis, j] = torch.from_numpy(value)
            t["past.from"][axis, j] = voltages[0].size - voltages[j].size
        if pasts:
            t["past.voltages"][axis, : voltages[0].size] = torch.from_numpy(voltages[0])
            t["past.written"][axis] = voltages[0].size
        t["confirmed"][axis] = False
        self._rest[axis] = rest

    def read(self, axis: int) -> StateDict:
        """Inverse of ``load``."""
        state = dict(self._rest[axis])
        t = self._tensors
        for name in self._plain:
            value = t[name][axis].cpu().numpy()
            state[name] = value.copy() if value.ndim else value.item()
        for name, columns in _PACKED.items():
            state.update(zip(columns, t[name][axis].tolist(), strict=True))
        for name in ("gain", "offset_um"):
            state[f"front.track.features.{name}"] = state[f"{_FRAME}{name}"]
        rows, taken = t["delay"].shape[1], int(t["delay.count"][axis])
        order = np.arange(max(taken - rows, 0), taken) % rows
        state["delay"] = t["delay"][axis].cpu().numpy()[order]
        ring, written = t["past.voltages"][axis].cpu().numpy(), int(t["past.written"][axis])
        for j in range(int(t["past.count"][axis])):
            for name in PAST:
                state[f"front.past{j}.{name}"] = t[f"past.{name}"][axis, j].cpu().numpy().copy()
            state[f"front.past{j}.u_V"] = ring[np.arange(int(t["past.from"][axis, j]), written) % ring.size]
        return state

    def _write(self, name: str, axis: int, value: object) -> None:
        row = self._tensors[name][axis]
        given = torch.as_tensor(np.asarray(value), dtype=row.dtype)
        if given.shape != row.shape:
            raise ValueError(f"{name}: got shape {tuple(given.shape)}, expected {tuple(row.shape)}")
        row.copy_(given)
