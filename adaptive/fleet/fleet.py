"""A fleet: B independent learners as one batch, sample by sample the same as B single learners.

An axis whose readings are ordinary is stepped with all others by operations of torch, without a branch for one axis.
Readings that are far from the prediction, gaps, restarts, trials of a sensor, returns to the identified model and
repairs of a window are rare. Such an axis is *apart*: from that sample on a single learner (``adaptive.online``) has
its state and handles its samples, until it is ordinary again. So every rule of the single learner holds for each axis,
and a refused axis costs the others nothing but the time of one single learner.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Protocol

import numpy as np
import torch
from torch import Tensor

from adaptive.errors import InputError, ModelFileError
from adaptive.fleet import checks
from adaptive.fleet.checks import CODE, OPEN, Admitted
from adaptive.fleet.compiled import CompiledMatrices
from adaptive.fleet.config import FleetConfig
from adaptive.fleet.in_torch import TorchMatrices
from adaptive.fleet.motion import Instant, Smoothing, inputs, memory_now
from adaptive.fleet.snapshot import FleetSnapshot, snapshot_of
from adaptive.fleet.state import OUTCOMES, BatchState, check_alike, constants_of, distinct
from adaptive.inverse_model import LssvmInverse
from adaptive.online import drift, gates
from adaptive.online.glitch_or_jump import MOST_BRIDGED
from adaptive.online.kernel_window import NOWHERE, ResidualWindow
from adaptive.online.learner import MARK_S, Learner
from adaptive.online.sensor_trust import CONFIRMED
from adaptive.types import FloatArray, IntArray, Sample, StateDict
from adaptive.window.arrays import ACCEPTED, ILL_CONDITIONED, WindowArrays


class Matrices(Protocol):
    """Windows and drift filters of B axes; ``axes`` (k,) are numbers of axes, without repeats."""

    #: Whether ``arrays`` gives the state itself, not a copy.
    shares: bool

    def arrays(self, axis: int) -> WindowArrays: ...
    def put(self, axis: int, arrays: WindowArrays) -> None: ...
    def samples(self) -> tuple[Tensor, ...]: ...
    def predict(self, axes: Tensor, points: Tensor) -> Tensor: ...
    def frozen(self, axes: Tensor, basis: Tensor, kernel: Tensor) -> Tensor: ...
    def learn(self, axes: Tensor, points: Tensor, targets: Tensor, weights: Tensor, fade_steps: float) -> Tensor: ...
    def let_go(self, axes: Tensor, most: float) -> None: ...
    def drift(self, axes: Tensor, basis: Tensor, targets: Tensor, moving: Tensor, weights: Tensor) -> Tensor: ...


#: Result of an axis that had no sample.
NO_SAMPLE = -1


class Fleet:
    """Learns B axes online. Not for several threads at once; snapshots may be used anywhere."""

    def __init__(self, models: Sequence[LssvmInverse], config: FleetConfig | None = None) -> None:
        """``models`` : the identified model of each axis. Raises InputError where their shapes differ."""
        self.config = config = config or FleetConfig()
        check_alike(models)
        numbers, firsts = distinct(models)
        templates = [Learner(models[i], config.learner) for i in firsts]
        self._c = c = constants_of(models, config, templates, numbers)
        self._s = s = BatchState(c)
        arrays = [template.parts.window.window_arrays for template in templates]
        self._matrices: Matrices = (
            TorchMatrices(c, s, arrays[0]) if config.in_torch else CompiledMatrices(c, s, arrays[0], config.threads)
        )
        self._smoothing = Smoothing(c)
        self._apart: dict[int, Learner] = {}
        self._shells: dict[int, Learner] = {}
        self._is_apart = torch.zeros(c.axes, dtype=torch.bool, device=c.span_V.device)
        self._cache: FleetSnapshot | None = None
        for i in range(c.axes):
            self._matrices.put(i, arrays[numbers[i]])
        starts = [template.parts.state_dict(arrays=False) | {"frozen": False} for template in templates]
        for i in range(c.axes):
            # Before its first sample an axis has no place: the single learner takes that one.
            learner = self._learner(i)
            learner.resume(starts[numbers[i]] | {"domain": models[i].domain.copy()}, arrays=False)
            self._set_apart(i, learner)

    # ---- samples in

    @property
    def axes(self) -> int:
        """B."""
        return self._c.axes

    @property
    def bases(self) -> tuple[LssvmInverse, ...]:
        """The identified models."""
        return self._c.bases

    @property
    def dt_s(self) -> float:
        """Sample time, s."""
        return self._c.dt_s

    def step(self, seq: object, t_s: object, u_V: object, y_um: object, present: object = True) -> IntArray:
        """Take one sample of each axis that is ``present``; arguments are (B,) or one value for all.

        Returns (B,) results: the number of the outcome in ``OUTCOMES``, NO_SAMPLE for an axis that is not present.
        Never raises on the values of samples; raises InputError on shapes.
        """
        c = self._c
        taken = self._given("present", present, torch.bool)
        sample = (self._given("seq", seq, torch.int64), *(self._given(name, value, torch.float64) for name, value in
                  (("t_s", t_s), ("u_V", u_V), ("y_um", y_um))))  # fmt: skip
        outcome = torch.full((c.axes,), NO_SAMPLE, dtype=torch.int64, device=taken.device)
        inside = taken & ~self._is_apart
        if bool(inside.any()):
            self._step_together(inside, sample, outcome)
        said = outcome.cpu().numpy()
        apart = [axis for axis in self._apart if bool(taken[axis])]
        if apart:
            rows = [part.tolist() for part in sample]
            for axis in apart:
                said[axis] = self._step_apart(axis, Sample(*(row[axis] for row in rows)))
        return said

    def _given(self, name: str, value: object, kind: torch.dtype) -> Tensor:
        given = torch.as_tensor(np.asarray(value), dtype=kind)
        if given.ndim > 1 or (given.ndim == 1 and given.shape[0] != self.axes):
            raise InputError(f"{name}: got shape {tuple(given.shape)}, expected ({self.axes},) or one value for all")
        return given.expand(self.axes).to(self._c.span_V.device)

    def _step_apart(self, axis: int, sample: Sample) -> int:
        learner = self._apart[axis]
        outcome = learner.handle(sample)
        self._cache = None
        if learner.parts.ordinary:
            self._bring_back(axis)
        return CODE[outcome]

    def _step_together(self, inside: Tensor, sample: tuple[Tensor, ...], outcome: Tensor) -> None:
        c, s = self._c, self._s
        admitted = checks.admit(c, s, *sample)
        doubt = inside & admitted.doubt
        due = (inside & admitted.control).nonzero()[:, 0]
        if due.numel():
            # As many control trials at a time as the configuration allows, those that wait longest first.
            room = self.config.checks - sum(1 for one in self._apart.values() if one.parts.intake.controls)
            order = s["front.until_control"][due].argsort(stable=True)
            doubt[due[order[: max(room, 0)]]] = True
        going = inside & ~doubt & (admitted.refused == OPEN)
        u_V, y_um = sample[2], torch.where(going, sample[3], 0.0)
        instant = self._smoothing.step(s, y_um)
        lesson = _Lesson(self, going, admitted, instant)
        doubt |= lesson.leaves
        going &= ~lesson.leaves
        refused = inside & ~doubt & (admitted.refused != OPEN)
        outcome[refused] = admitted.refused[refused]
        axes = going.nonzero()[:, 0]
        # Gathered first: an entry may be another's value before the sample.
        for name, value in [(name, value[axes]) for name, value in admitted.new.items()]:
            s[name][axes] = value
        self._note_voltage(axes, u_V)
        self._smoothing.write(s, axes, instant, u_V, y_um)
        outcome[axes] = lesson.outcome[axes]
        failed = lesson.learn(going, outcome)
        counted = (refused | going).nonzero()[:, 0]
        s["counters"][counted, outcome[counted]] += 1
        if axes.numel():
            self._cache = None
        for axis in doubt.nonzero()[:, 0].tolist():
            self._take_out(axis)
        for axis in failed.tolist():
            self._take_out(axis).parts.window.begin_healing()

    def _note_voltage(self, axes: Tensor, u_V: Tensor) -> None:
        """Note a voltage for the known places of ``axes``; a place from too long ago makes way for the present one."""
        s = self._s
        written = s["past.written"][axes]
        s["past.voltages"][axes, written % s["past.voltages"].shape[1]] = u_V[axes]
        s["past.written"][axes] = written + 1
        old = (s["past.count"][axes] > 0) & (written + 1 - s["past.from"][axes, 0] > MOST_BRIDGED)
        if bool(old.any()):
            self.remember_place(axes[old], keep=1)

    def remember_place(self, axes: Tensor, keep: int) -> None:
        """The present place of ``axes`` becomes the newest known one: after the last (``keep`` 0), or in its stead."""
        c, s = self._c, self._s
        lag, slots = c.sizes["lag"], c.sizes["lag"] + 2
        count = s["front.track.smoother.count"][axes]
        numbers = count[:, None] - lag + torch.arange(lag, device=count.device)
        voltages, readings = s["front.track.u_V"][axes], s["front.track.y_um"][axes]
        place = {
            "motion": s["front.track.motion"][axes],
            "u_before_V": voltages.gather(1, ((count - lag - 1) % slots)[:, None])[:, 0],
            "lag_V": voltages.gather(1, numbers % slots),
            "lag_um": readings.gather(1, numbers % slots),
            "memory": s["front.track.memory"][axes],
            "from": s["past.written"][axes],
        }
        full = s["past.count"][axes]
        at = torch.where(full == 0, 0, 1) if keep == 0 else full - 1
        shift = (full == 2).nonzero()[:, 0]
        for name, value in place.items():
            past = s[f"past.{name}"]
            past[axes[shift], 0] = past[axes[shift], 1]
            past[axes, at] = value
        s["past.count"][axes] = at + 1

    # ---- in and out of the batch

    def _learner(self, axis: int) -> Learner:
        """The single learner of an axis, over the axis' own window."""
        if axis not in self._shells or not self._matrices.shares:
            base, c = self._c.bases[axis], self.config.learner
            window = ResidualWindow.over(self._matrices.arrays(axis), base, c.eviction, c.solver)
            self._shells[axis] = Learner.around(base, c, window, float(self._c.allowed_V[axis]))
        return self._shells[axis]

    def _set_apart(self, axis: int, learner: Learner) -> Learner:
        self._apart[axis] = learner
        self._is_apart[axis] = True
        self._cache = None
        return learner

    def _take_out(self, axis: int) -> Learner:
        learner = self._learner(axis)
        learner.resume(self._s.read(axis), arrays=False)
        return self._set_apart(axis, learner)

    def _bring_back(self, axis: int) -> None:
        learner = self._apart.pop(axis)
        self._matrices.put(axis, learner.parts.window.window_arrays)
        if learner.parts.window.window_arrays is not self._matrices.arrays(axis):
            del self._shells[axis]
        self._s.load(axis, learner.parts.state_dict(arrays=False) | {"frozen": learner.frozen})
        self._is_apart[axis] = False

    def export_axis(self, axis: int) -> StateDict:
        """The whole state of an axis, as of ``Learner.state_dict``."""
        return self.learner_of(axis).state_dict()

    def load_axis(self, axis: int, state: StateDict) -> None:
        """Continue an axis from the state of a single learner of the same model and configuration.

        Raises ModelFileError, and leaves the axis as it is, where it is of another.
        """
        given = Learner.from_state(state)
        base = self._c.bases[axis]
        if given.base.features != base.features or not np.array_equal(given.base.beta, base.beta):
            raise ModelFileError(f"axis {axis}: the state is of another model; load the one of this axis")
        if given.config != self.config.learner:
            raise ModelFileError(f"axis {axis}: the state is of another configuration of the learner")
        self._apart.pop(axis, None)
        self._shells.pop(axis, None)
        self._matrices.put(axis, given.parts.window.window_arrays)
        learner = self._learner(axis)
        learner.resume(state, arrays=False)
        self._set_apart(axis, learner)
        if learner.parts.ordinary:
            self._bring_back(axis)

    # ---- learning on and off

    def freeze(self, axes: Iterable[int]) -> None:
        """Stop learning of some axes."""
        for axis in axes:
            self._switch(axis, True)

    def thaw(self, axes: Iterable[int]) -> None:
        """Let some axes learn again."""
        for axis in axes:
            self._switch(axis, False)

    def _switch(self, axis: int, frozen: bool) -> None:
        self._s["frozen"][axis] = frozen
        learner = self._apart.get(axis)
        if learner is not None:
            (learner.freeze if frozen else learner.thaw)()

    def resync(self, axes: Iterable[int]) -> None:
        """Forget the sequence of some axes: their next sample is taken whatever its number."""
        for axis in axes:
            (self._apart.get(axis) or self._take_out(axis)).resync()

    # ---- models out

    def snapshot(self) -> FleetSnapshot:
        """The models of all axes as they stand, immutable; the same object while nothing was learnt."""
        if self._cache is None:
            self._cache = snapshot_of(self._c, self._s, self._matrices, self._apart)
        return self._cache

    def memory(self) -> FloatArray:
        """(B, m) hysteresis memory with which each axis' served model goes on from its last sample."""
        frozen = self._s["judgement.fallback"][:, None]
        memory = torch.where(frozen, memory_now(self._c, self._s, True), memory_now(self._c, self._s, False))
        out = memory.cpu().numpy().copy()
        for axis, learner in self._apart.items():
            kept = learner.memory_for(learner.snapshot())
            out[axis] = learner.memory() if kept is None else kept
        return np.asarray(out, dtype=np.float64)

    # ---- reports

    def counters(self, axis: int) -> dict[str, int]:
        """Samples of an axis by outcome, and events; see `Learner.counters`."""
        return self.learner_of(axis).counters()

    def learner_of(self, axis: int) -> Learner:
        """A copy of an axis as a single learner, to look into."""
        if axis in self._apart:
            return self._apart[axis]
        learner = self._learner(axis)
        learner.resume(self._s.read(axis), arrays=False)
        return learner

    def outcomes(self) -> IntArray:
        """(B, outcomes) samples by outcome, in the order of ``OUTCOMES``."""
        out = self._s["counters"].cpu().numpy().copy()
        for axis, learner in self._apart.items():
            out[axis] = [learner.parts.counters[name] for name in OUTCOMES]
        return np.asarray(out, dtype=np.int64)

    def rms_error_pct(self) -> FloatArray:
        """(B,) rms error of the last 0.1 s, percent of the voltage span."""
        out = self._s["judgement.short_V2"].cpu().numpy().copy()
        for axis, learner in self._apart.items():
            out[axis] = learner.parts.judgement.short_V2
        return np.asarray(100.0 * np.sqrt(out) / self._c.span_V.cpu().numpy(), dtype=np.float64)

    def troubles(self) -> dict[int, str]:
        """Names of what keeps axes from learning, by axis; see `Learner.trouble`. Such an axis is apart."""
        return {axis: one.trouble for axis, one in sorted(self._apart.items()) if one.trouble}

    @property
    def apart(self) -> tuple[int, ...]:
        """The axes that are not ordinary at present."""
        return tuple(sorted(self._apart))


class _Lesson:
    """What a sample teaches: worked out for all axes first, then written for those that stay in the batch."""

    def __init__(self, fleet: Fleet, going: Tensor, admitted: Admitted, instant: Instant) -> None:
        self._fleet = fleet
        self._c, self._s, self._m = fleet._c, fleet._s, fleet._matrices
        c = self._c
        config = c.config.learner
        self._instant = instant
        self._new: dict[str, list[tuple[Tensor, Tensor]]] = {}
        admission, new = config.admission, admitted.new
        settling = torch.minimum(new["front.gates.since_start"], new["front.gates.since_step"]) <= admission.settle
        low, high = admission.u_min_V + admission.rail_margin_V, admission.u_max_V - admission.rail_margin_V
        u, before, y = instant.u_V, instant.u_before_V, instant.motion[:, 0]
        saturated = ~((u > low) & (u < high) & (before > low) & (before < high))
        outside = ~saturated & ~((y >= admission.y_min_um) & (y <= admission.y_max_um))
        filters, windows = instant.now % config.filter_every == 0, instant.now % config.learn_every == 0
        self.outcome = torch.where(saturated, CODE[gates.SATURATED], CODE[gates.PASSED])
        for gate, where in ((gates.OUT_OF_RANGE, outside), (gates.GLITCH, ~instant.good), (gates.SETTLING, settling)):
            self.outcome = torch.where(where, CODE[gate], self.outcome)
        teaches = going & ~settling & instant.good & ~outside & (filters | windows)
        self.axes = axes = teaches.nonzero()[:, 0]
        self.leaves = torch.zeros_like(going)
        self._saturated, self._windows = saturated[axes], windows[axes]
        self._motion, self._u = instant.motion[axes], u[axes]
        if axes.numel():
            self._prepare(filters[axes])

    def _prepare(self, filters: Tensor) -> None:
        c, s, axes, motion = self._c, self._s, self.axes, self._motion
        config, dt_s = c.config.learner, c.dt_s
        gain, offset = s["front.track.served.gain"][axes], s["front.track.served.offset_um"][axes]
        self._basis, self._point = inputs(c, axes, motion, self._instant.memory[axes], gain, offset)
        count = s["front.track.smoother.count"][axes] + 1
        admission = config.admission.at(dt_s)
        moved = (motion[:, 0] - s["front.gates.anchor_um"][axes]).abs() > admission.rest_share * c.range_um[axes]
        anchor = torch.where(moved, motion[:, 0], s["front.gates.anchor_um"][axes])
        since = torch.where(moved, count, s["front.gates.moved"][axes])
        self._rest = (count - since) * dt_s > admission.rest_s
        self._put(axes, {"front.gates.anchor_um": anchor, "front.gates.moved": since, "point": self._point})
        weights = config.weights
        self._weight = torch.where(self._instant.near_bad[axes], weights.near_bad, 1.0)
        self._weight = self._weight.to(torch.float64)
        if weights.acceleration > 0.0:
            share = weights.acceleration * motion[:, 2] * c.scale[axes, 3]
            self._weight = self._weight / (1.0 + share**2)
        self._filters = filters
        self._judge(filters.nonzero()[:, 0])

    def _judge(self, rows: Tensor) -> None:
        """Errors of the models as they were served, and all checks, of the ``rows`` whose filter is due."""
        c, s, axes = self._c, self._s, self.axes[rows]
        basis, u = self._basis[rows], self._u[rows]
        target = u - self._m.predict(axes, self._point[rows])
        self._target = torch.zeros_like(self._u).index_copy(0, rows, target)
        self._finite = torch.ones_like(self._rest).index_copy(0, rows, torch.isfinite(target))
        frame = c.frame[axes]
        frozen_inputs = inputs(c, axes, self._motion[rows], self._instant.frozen_memory[axes], frame[:, 0], frame[:, 1])
        frozen_V = self._m.frozen(axes, *frozen_inputs)
        beta, count = s["filter.beta"][axes], s["delay.count"][axes]
        size = s["delay"].shape[1]
        oldest = torch.where(count + 1 > size, (count + 1) % size, 0)
        served = s["delay"][axes, oldest] if size > 1 else beta
        served = torch.where((count == 0)[:, None], beta, served)
        fallen, new = checks.judge(c, s, axes, target - (basis * served).sum(1), u - frozen_V)
        self._put(axes, new)
        self._judged = dict(zip(("axes", "rows", "count"), (axes, rows, count), strict=True))
        self._valid = s["judgement.valid"][self.axes].index_copy(0, rows, new["judgement.valid"])
        self._short_V2, self._count = new["judgement.short_V2"], new["judgement.judged"]
        leaves = fallen
        every = c.check_every
        due = (self._instant.now[axes] % every == 0).nonzero()[:, 0]
        if due.numel():
            at, saturated = axes[due], self._saturated[rows[due]]
            away = u[due] - target[due] + (basis[due] * (beta[due] - c.beta[at])).sum(1)
            checks_s = every // c.config.learner.filter_every * c.step_s
            again, new = checks.watch(c, s, at, away, saturated, self._short_V2[due], checks_s)
            self._put(at, new)
            looks = ~saturated & (s["front.credit"][at] > 0) & c.tells[at]
            fault, new = checks.follow(c, s, at, u[due], frozen_V[due], checks_s)
            good = new["front.following.good"]
            confirmed = looks & ((good >= CONFIRMED) | (s["past.count"][at] == 0))
            self._confirmed = at[torch.where(saturated, s["confirmed"][at], confirmed)]
            self._placed = at[confirmed]
            new["front.following.good"] = torch.where(confirmed, 0, good)
            self._put(at[looks], {name: value[looks] for name, value in new.items()})
            self._put(at, {"confirmed": torch.where(saturated, s["confirmed"][at], confirmed)})
            leaves = leaves.index_put((due,), leaves[due] | again | (fault & looks))
        else:
            self._confirmed = self._placed = axes[:0]
        leaves &= torch.isfinite(target)
        self.leaves[axes] = leaves

    def _put(self, axes: Tensor, new: dict[str, Tensor]) -> None:
        for name, value in new.items():
            self._new.setdefault(name, []).append((axes, value))

    def learn(self, going: Tensor, outcome: Tensor) -> Tensor:
        """Write and learn for the axes that are ``going``. Returns those whose window refused the step for numerics."""
        c, s, m, config = self._c, self._s, self._m, self._c.config.learner
        if not self.axes.numel():
            return self.axes
        kept = going & ~self.leaves
        numerics = self.axes[~self._finite]
        kept_finite = kept.clone()
        kept_finite[numerics] = False
        for name, parts in self._new.items():
            late = name not in ("front.gates.anchor_um", "front.gates.moved", "point")
            for axes, value in parts:
                rows = (kept_finite if late else kept)[axes]
                s[name][axes[rows]] = value[rows]
        kept = kept_finite
        outcome[numerics] = CODE[gates.NUMERICS]
        self._mark(kept)
        frozen = s["frozen"][self.axes]
        open_rows = kept[self.axes] & ~self._saturated
        self._outcome = outcome
        outcome[self.axes[open_rows & frozen & self._filters]] = CODE[gates.FROZEN]
        learns = self._follow((open_rows & self._filters & ~frozen).nonzero()[:, 0], open_rows & ~frozen)
        rows = (learns & self._windows & ~self._rest & self._valid).nonzero()[:, 0]
        if not rows.numel():
            return self.axes[:0]
        axes, point, basis = self.axes[rows], self._point[rows], self._basis[rows]
        targets = self._u[rows] - (basis * s["filter.beta"][axes]).sum(1)
        half_life = config.weights.half_life_s / (config.learn_every * c.dt_s)
        status = m.learn(axes, point, targets, self._weight[rows], half_life)
        outcome[axes] = torch.where(status == ACCEPTED, CODE[gates.LEARNT], CODE[gates.NUMERICS])
        motion, domain = self._motion[rows], s["domain"][axes].reshape(-1, 3, 2)
        ends = torch.stack((torch.minimum(domain[:, :, 0], motion), torch.maximum(domain[:, :, 1], motion)), 2)
        s["domain"][axes] = ends.reshape(-1, 6)
        return axes[status == ILL_CONDITIONED]

    def _mark(self, kept: Tensor) -> None:
        """Past estimates: those that answers still use, those to return to, and those that motion has confirmed."""
        c, s, axes = self._c, self._s, self._judged["axes"]
        rows = kept[axes]
        axes, count = axes[rows], self._judged["count"][rows]
        s["delay"][axes, count % s["delay"].shape[1]] = s["filter.beta"][axes]
        s["delay.count"][axes] = count + 1
        limit = (0.5 * c.config.learner.valid_enter * c.span_V[axes]) ** 2
        judged = self._count[rows]
        good = (judged % max(1, round(MARK_S / c.step_s)) == 0) & (self._short_V2[rows] < limit)
        if bool(good.any()):
            at = axes[good]
            self._copy(at, "next_mark", "mark")
            self._copy(at, "filter", "next_mark")
            s["mark_ages"][at] = torch.stack((s["mark_ages"][at, 1], judged[good]), 1)
            newer = at[s["confirmed_ages"][at, 0] < s["mark_ages"][at, 0]]
            self._copy(newer, "mark", "confirmed0")
            s["confirmed_ages"][newer, 0] = s["mark_ages"][newer, 0]
        at = self._confirmed[kept[self._confirmed]]
        if at.numel():
            newer = at[s["confirmed_ages"][at, 1] >= s["confirmed_ages"][at, 0]]
            self._copy(newer, "confirmed1", "confirmed0")
            self._copy(at, "filter", "confirmed1")
            s["confirmed_ages"][newer, 0] = s["confirmed_ages"][newer, 1]
            s["confirmed_ages"][at, 1] = s["judgement.judged"][at]
        placed = self._placed[kept[self._placed]]
        if placed.numel():
            self._fleet.remember_place(placed, keep=0)

    def _copy(self, axes: Tensor, source: str, target: str) -> None:
        for name in ("beta", "covariance"):
            self._s[f"{target}.{name}"][axes] = self._s[f"{source}.{name}"][axes]

    def _follow(self, rows: Tensor, learns: Tensor) -> Tensor:
        """One step of the filters of ``rows``; returns (k,) which of the axes may learn in their windows."""
        s, m, config = self._s, self._m, self._c.config.learner
        if not rows.numel():
            return learns
        axes, rest = self.axes[rows], self._rest[rows]
        said = m.drift(axes, self._basis[rows], self._target[rows], ~rest, self._weight[rows])
        self._outcome[axes] = torch.where(rest, CODE[gates.UNEXCITED], CODE[gates.LEARNT])
        self._outcome[axes[said == 1]] = CODE[gates.OUTLIER]
        learns = learns.index_put((rows,), said != 1)
        changed = axes[said == 2]
        s["window.changed"][changed], s["window.next"][changed] = s["window.clock"][changed], 0
        fading = axes[(said != 1) & self._valid[rows] & (s["window.next"][axes] != NOWHERE)]
        if fading.numel():
            m.let_go(fading, config.weights.before_change)
        self._creep(axes[said != 1], rest[said != 1], self._u[rows][said != 1])
        return learns

    def _creep(self, axes: Tensor, rest: Tensor, u_V: Tensor) -> None:
        """Move the gain of the constant at rest to the frame; see `RestCreep`."""
        c, s = self._c, self._s
        creep_s, every, span, step_s = c.config.learner.creep_s, drift.FRAME_EVERY, c.span_V[axes], c.step_s
        constant = s["filter.beta"][axes, 0]
        begins = s["rest.constant_V"][axes].isnan()
        start = torch.where(begins, constant, s["rest.constant_V"][axes])
        voltage = torch.where(begins, u_V, s["rest.u_V"][axes])
        steps = s["rest.steps"][axes] + 1
        due = rest & (steps % every == 0) & (creep_s > 0.0)
        change = (u_V - voltage).abs()
        ends = ~rest | (due & (change > drift.STILL_PER_S * span * every * step_s))
        most = drift.FASTEST_PER_S * c.range_um[axes] * every * step_s
        gained = (constant - start) * c.range_um[axes] / span
        shift = -torch.minimum(
            torch.maximum(gained * min(1.0, every * step_s / creep_s if creep_s else 0.0), -most), most
        )
        s["rest.constant_V"][axes] = torch.where(ends, torch.nan, start)
        s["rest.u_V"][axes] = torch.where(ends, torch.nan, torch.where(due, u_V, voltage))
        s["rest.steps"][axes] = torch.where(ends, 0, steps)
        moves = due & ~ends
        s["front.track.served.offset_um"][axes[moves]] += shift[moves]
