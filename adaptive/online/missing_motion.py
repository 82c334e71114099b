"""The hysteresis memory after a gap: what the stage may have done while its samples were missing.

After a gap the place is known and the memory is not: it depends on where the stage turned meanwhile. An ensemble of
memories stands for the possible motions: straight to the new place, or by turning points above and below it, in both
orders, as far as the stage can go in that time with its largest known velocity and acceleration. Their mean is served.
The spread of their voltages is added to the stated deviation.

Each member then follows the readings, and the voltages correct them all: an ensemble Kalman filter of the memory alone
(the deterministic one of Whitaker and Hamill, 2002). Plays that the motion wipes out become equal by themselves. The
states that a play memory can have form a convex set, so the mean of members is such a state. The gap is closed where
the voltages agree, at the place and away from it, or after some time of motion: what is then left counts as an error
of the model.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Final

import numpy as np

from dehyst.adaptive.compiled import compiled
from dehyst.adaptive.features import advance, fill
from dehyst.adaptive.inverse_model import LssvmInverse, mean_of, track_memory, unpacked
from dehyst.adaptive.state import Entry
from dehyst.adaptive.types import FloatArray, IntArray

#: Turning points, as shares of the way from the two known places to the farthest one that can be reached.
TURNS: Final = (0.0, 0.1, 0.4, 1.0)
#: Points of a path through the gap.
PATH_POINTS: Final = 60
#: Assumed length of a gap of unknown length, s: slow states are relaxed, and every place can be reached.
UNKNOWN_S: Final = 10.0
#: Deviation of the first voltage, as a share of the span: its velocity and acceleration are not known yet.
FIRST_SHARE: Final = 0.01
#: Variance of a voltage over that of the model's error: successive errors are alike.
ALIKE: Final = 10.0
#: The model's error after a gap over its rms error just before it, which differs along the motion.
NOISE_FACTOR: Final = 2.0
#: Least deviation of the model's error, as a share of the span.
LEAST_SHARE: Final = 1e-4
#: Distance, as a share of the range, at which the voltages are compared beside the place itself.
PROBE_SHARE: Final = 0.15
#: Steps of the filter between two comparisons.
PROBE_EVERY: Final = 5
#: The gap is closed where the spread is below the model's error, or this share of the span. Each time in motion that
#: has passed, s, adds as much: motion that tells little must not stop the learning. The longest time in motion, s.
CLOSED_SHARE, PATIENCE_S, LONGEST_S = 3e-4, 0.25, 1.0


@dataclass(slots=True)
class MissingMotion:
    """An open gap."""

    model: Annotated[LssvmInverse, Entry("as before the gap, in the frame that is served; learnt only at rest")]
    members: Annotated[FloatArray, Entry("possible memories", "µm", "*,m", most=4096)]
    noise_V: Annotated[float, Entry("deviation of the model's error", "V", low=0.0)]
    std_V: Annotated[float, Entry("spread of the members' voltages", "V", low=0.0)] = 0.0
    since: Annotated[int, Entry("smoothed instants since the gap", low=0)] = 0
    moved_s: Annotated[float, Entry("time of motion since", "s", low=0.0)] = 0.0
    rests: Annotated[bool, Entry("whether the stage is at rest")] = False

    def check_state(self) -> None:
        """Raise ValueError where there are no members, or they are not of the model."""
        if not len(self.members) or self.members.shape[1] != self.model.memory_size:
            raise ValueError(f"members: {self.members.shape}, expected some of {self.model.memory_size} entries")

    @classmethod
    def begin(
        cls,
        model: LssvmInverse,
        memory: FloatArray,
        from_um: float,
        to_um: float,
        u_V: float,
        seconds: float,
        noise_V: float,
        earlier: MissingMotion | None = None,
    ) -> MissingMotion:
        """Between two readings, µm, that are ``seconds`` apart; ``u_V`` : voltage of the second one.

        ``memory`` : (m,) at the first one. ``earlier`` : a gap that was still open there.
        """
        top_um, bottom_um = max(from_um, to_um), min(from_um, to_um)
        fastest = float(np.max(np.abs(model.domain[2:4])))
        hardest = float(np.max(np.abs(model.domain[4:6])))
        # A turn with the acceleration a takes the stage a t² / 8 beyond both places.
        reach_um = max(0.0, min(0.5 * (fastest * seconds - (top_um - bottom_um)), hardest * seconds**2 / 8.0))
        above = min(reach_um, max(0.0, float(model.domain[1]) - top_um))
        below = min(reach_um, max(0.0, bottom_um - float(model.domain[0])))
        turns = [(top_um + up * above, bottom_um - down * below) for up in TURNS for down in TURNS]
        paths = [*turns, *((low, high) for high, low in turns)]
        before = memory[np.newaxis] if earlier is None else earlier.members
        arrays = model.features.arrays
        # A path has fewer points than samples are missing: the slow states relax by several samples in each step.
        arrays = arrays._replace(retain=arrays.retain ** (seconds / model.dt_s / PATH_POINTS))
        members = np.empty((len(paths), model.memory_size))
        for i, (first, second) in enumerate(paths):
            # An earlier gap's members are dealt out so that like ones do not get like paths.
            members[i] = before[(7 * i + 3) % before.shape[0]]
            track_memory(_path(from_um, first, second, to_um), members[i], arrays)
        noise_V = max(NOISE_FACTOR * noise_V, LEAST_SHARE * model.span_V)
        made = cls(model, members, noise_V, moved_s=0.0 if earlier is None else earlier.moved_s)
        _correct(to_um, 0.0, 0.0, u_V, (FIRST_SHARE * model.span_V) ** 2, members, *model.packed)
        made.compare((to_um, 0.0, 0.0))
        return made

    @property
    def memory(self) -> FloatArray:
        """(m,) the mean of the members."""
        mean: FloatArray = self.members.mean(axis=0)
        return mean

    def advance(self, y_um: float) -> None:
        """All members follow one smoothed place, µm."""
        _advance_all(y_um, self.members, *self.model.packed)
        self.since += 1

    def stand(self) -> None:
        """The stage is at rest: the learner learns the zero, and the memory stays as it is."""
        self.rests = True

    def move(self, model: Callable[[], LssvmInverse], step_s: float) -> None:
        """The stage has moved for ``step_s``; ``model`` returns the model with what was learnt at rest."""
        if self.rests:
            self.rests, self.model = False, model()
        self.moved_s += step_s

    def correct(self, motion: tuple[float, float, float], u_V: float, weight: float) -> None:
        """Correct the members, advanced to ``motion`` (µm, µm/s, µm/s²), by the voltage there. ``weight`` : 0 to 1."""
        variance = ALIKE * self.noise_V**2 / weight
        _correct(*motion, u_V, variance, self.members, *self.model.packed)

    @property
    def closed(self) -> bool:
        """Whether what is missing no longer matters, or has been waited for long enough."""
        close_V = max((1.0 + self.moved_s / PATIENCE_S) * self.noise_V, CLOSED_SHARE * self.model.span_V)
        return self.std_V <= close_V or self.moved_s > LONGEST_S

    def compare(self, motion: tuple[float, float, float]) -> None:
        """Take the spread anew: the largest distance of a voltage from their mean, here and on both sides."""
        f = self.model.features
        away_um = PROBE_SHARE * (f.y_max_um - f.y_min_um) * f.gain
        y, v, a = motion
        places = np.array([y - away_um, y, y + away_um])
        self.std_V = float(_largest_distance(places, v, a, self.members, *self.model.packed))


def _path(*corners_um: float) -> FloatArray:
    """(``PATH_POINTS``,) places, µm, along straight lines through the corners at constant speed; corners included."""
    way = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(corners_um)))])
    between = np.linspace(0.0, way[-1], PATH_POINTS - len(corners_um) + 3)[1:]
    # Sorted: corners are places too, so that a play reaches them.
    path: FloatArray = np.interp(np.sort(np.concatenate([between, way[1:-1]])), way, corners_um)
    return path


@compiled
def _advance_all(
    y_um: float, members: FloatArray, constants: FloatArray, counts: IntArray
) -> None:  # pragma: no cover - compiled
    m = unpacked(constants, counts)[0]
    for c in range(members.shape[0]):
        advance(y_um, members[c], m)


@compiled
def _voltages(
    y: float,
    v: float,
    a: float,
    move: bool,
    members: FloatArray,
    constants: FloatArray,
    counts: IntArray,
    u: FloatArray,
) -> None:  # pragma: no cover - compiled
    """Voltages, V, of all members at a place; ``move``: they are moved there, as copies, first."""
    m, beta, inverse_widths, alpha, scaled, _ = unpacked(constants, counts)
    basis, kernel, at = np.empty(beta.shape[0]), np.empty(inverse_widths.shape[0]), np.empty(members.shape[1])
    for c in range(members.shape[0]):
        at[:] = members[c]
        if move:
            advance(y, at, m)
        fill(y, v, a, at, m, basis, kernel)
        u[c] = mean_of(basis, kernel, beta, scaled, alpha, inverse_widths)


@compiled
def _correct(
    y: float,
    v: float,
    a: float,
    u_V: float,
    variance: float,
    members: FloatArray,
    constants: FloatArray,
    counts: IntArray,
) -> None:  # pragma: no cover - compiled
    n, size = members.shape
    u = np.empty(n)
    _voltages(y, v, a, False, members, constants, counts, u)
    mean_u = u.mean()
    spread = ((u - mean_u) ** 2).mean()
    if not (np.isfinite(spread) and spread > 0.0):
        return
    total = spread + variance
    less = 1.0 / (1.0 + np.sqrt(variance / total))
    for j in range(size):
        mean = members[:, j].mean()
        gain = ((members[:, j] - mean) * (u - mean_u)).mean() / total
        for c in range(n):
            members[c, j] += gain * (u_V - mean_u) - less * gain * (u[c] - mean_u)


@compiled
def _largest_distance(
    places: FloatArray, v: float, a: float, members: FloatArray, constants: FloatArray, counts: IntArray
) -> float:  # pragma: no cover - compiled
    u = np.empty(members.shape[0])
    largest = 0.0
    for i in range(places.shape[0]):
        _voltages(places[i], v, a, True, members, constants, counts, u)
        largest = max(largest, np.abs(u - u.mean()).max())
    return largest
