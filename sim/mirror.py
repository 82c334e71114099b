"""A deformable mirror: many piezo actuators under one face plate, each with its own hysteresis, creep and gain.

An actuator's stroke is a Prandtl-Ishlinskii operator of its voltage, plus creep (leaky integrals with log-spaced time
constants); a sensor of its own reads the stroke. The face plate adds the strokes up by influence functions, Gaussian in
the distance: a neighbour moves the surface by ``coupling`` of what it moves at its own place. Vectorised over the
actuators; `sim.stage` has the effects of a single stage in full.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from dehyst.adaptive.errors import InputError
from dehyst.adaptive.types import BoolArray, FloatArray

#: Play thresholds, V; time constants of the creep, s, and its size, µm per µm, of each of them.
_THRESHOLDS_V = np.geomspace(0.05, 3.0, 12)
_CREEP_S, _CREEP = np.geomspace(0.1, 30.0, 4), 0.006


@dataclass(frozen=True, slots=True)
class MirrorConfig:
    """side : actuators along each side of the square grid. stroke_um_per_V : mean gain at small voltages.

    hysteresis : share of the stroke that the plays make. gain_spread, hysteresis_spread : relative standard deviations
    over the actuators. coupling : influence of an actuator at its neighbour's place. noise_um : rms noise of a sensor.
    """

    side: int = 32
    dt_s: float = 1e-3
    stroke_um_per_V: float = 1.0
    hysteresis: float = 0.3
    gain_spread: float = 0.04
    hysteresis_spread: float = 0.15
    coupling: float = 0.12
    noise_um: float = 5e-4
    seed: int = 0

    def __post_init__(self) -> None:
        if not 2 <= self.side <= 128:
            raise InputError(f"side: got {self.side}, expected 2 to 128 actuators")
        if not 0.0 <= self.coupling < 0.3:
            raise InputError(f"coupling: got {self.coupling}, expected 0 to 0.3")
        for name in ("dt_s", "stroke_um_per_V"):
            if not getattr(self, name) > 0.0:
                raise InputError(f"{name}: got {getattr(self, name)}, expected a positive number")

    @property
    def actuators(self) -> int:
        """Number of actuators."""
        return self.side * self.side


@dataclass(slots=True)
class MirrorState:
    """plays_V (B, K), creep_um (B, M), stroke_um (B,) of the next sample k. dead (B,) : which keep their stroke."""

    plays_V: FloatArray
    creep_um: FloatArray
    stroke_um: FloatArray
    dead: BoolArray
    k: int = 0


@dataclass(frozen=True)
class Mirror:
    """Steps a configuration through time; all that moves is in a `MirrorState`."""

    config: MirrorConfig
    gain_um_per_V: FloatArray = field(init=False)
    weights: FloatArray = field(init=False)
    influence: FloatArray = field(init=False)

    def __post_init__(self) -> None:
        c = self.config
        rng = np.random.default_rng(c.seed)
        gain = c.stroke_um_per_V * np.clip(1.0 + c.gain_spread * rng.normal(size=c.actuators), 0.8, 1.2)
        share = c.hysteresis * np.clip(1.0 + c.hysteresis_spread * rng.normal(size=c.actuators), 0.3, 1.7)
        plays = rng.uniform(0.7, 1.3, (c.actuators, _THRESHOLDS_V.size))
        weights = share[:, None] * plays / plays.sum(1, keepdims=True)
        at = np.array([(i, j) for i in range(c.side) for j in range(c.side)], dtype=np.float64)
        square = ((at[:, None] - at[None]) ** 2).sum(2)
        # A matrix of influence functions of this size that are cut where they no longer matter stays well conditioned.
        influence = np.where(square <= 9.0, max(c.coupling, 1e-12) ** square, 0.0)
        for name, value in (("gain_um_per_V", gain), ("weights", weights), ("influence", influence)):
            object.__setattr__(self, name, value)

    def initial_state(self) -> MirrorState:
        """Of actuators that have always been at rest at 0 V."""
        B = self.config.actuators
        return MirrorState(
            np.zeros((B, _THRESHOLDS_V.size)), np.zeros((B, _CREEP_S.size)), np.zeros(B), np.zeros(B, dtype=np.bool_)
        )

    def read(self, state: MirrorState) -> FloatArray:
        """(B,) sensor readings of the present strokes, µm."""
        rng = np.random.default_rng((self.config.seed, state.k))
        return np.asarray(state.stroke_um + self.config.noise_um * rng.normal(size=state.stroke_um.size))

    def step(self, state: MirrorState, u_V: FloatArray) -> None:
        """Hold the voltages (B,) V for one sample time; advances ``state``. Raises InputError where not finite."""
        u = np.asarray(u_V, dtype=np.float64)
        if u.shape != (self.config.actuators,) or not np.all(np.isfinite(u)):
            raise InputError(f"u_V: got shape {u.shape}, expected ({self.config.actuators},) finite voltages")
        r = _THRESHOLDS_V
        state.plays_V = np.clip(state.plays_V, u[:, None] - r, u[:, None] + r)
        plays = (self.weights * state.plays_V).sum(1)
        fast = self.gain_um_per_V * ((1.0 - self.weights.sum(1)) * u + plays)
        keep = np.exp(-self.config.dt_s / _CREEP_S)
        state.creep_um = fast[:, None] + (state.creep_um - fast[:, None]) * keep
        stroke = fast + _CREEP * state.creep_um.sum(1)
        state.stroke_um = np.where(state.dead, state.stroke_um, stroke)
        state.k += 1

    def kill(self, state: MirrorState, actuator: int) -> None:
        """From now on ``actuator`` keeps its stroke, whatever its voltage."""
        state.dead[actuator] = True

    def surface(self, stroke_um: FloatArray) -> FloatArray:
        """(side, side) displacement of the face plate, µm."""
        return np.asarray((self.influence @ stroke_um).reshape(self.config.side, self.config.side))

    def strokes(self, surface_um: FloatArray) -> FloatArray:
        """(n, B) strokes, µm, that make (n, B) surfaces: the inverse of the influence functions."""
        return np.asarray(np.linalg.solve(self.influence, surface_um.T).T)


@dataclass(frozen=True, slots=True)
class Wavefront:
    """A moving wavefront: a fixed random pattern that the wind carries over the mirror.

    rms_um : of its displacement. wind_per_s : actuator distances a second. modes : plane waves in it.
    """

    side: int
    rms_um: float = 0.8
    wind_per_s: float = 25.0
    modes: int = 40
    seed: int = 1

    def at(self, t_s: FloatArray) -> FloatArray:
        """(n, B) displacements, µm, at times (n,) s."""
        rng = np.random.default_rng(self.seed)
        # Turbulence has more of the long waves; the shortest here is four actuators long.
        k = rng.uniform(0.3, 1.6, self.modes)
        angle, phase = rng.uniform(0.0, 2.0 * np.pi, (2, self.modes))
        kx, ky, size = k * np.cos(angle), k * np.sin(angle), k**-1.3
        i, j = np.divmod(np.arange(self.side * self.side), self.side)
        still = i[:, None] * ky + j[:, None] * kx + phase
        wave = np.array([(size * np.sin(still - kx * self.wind_per_s * t)).sum(1) for t in t_s])
        return np.asarray(self.rms_um * wave / np.sqrt(0.5 * (size**2).sum()))
