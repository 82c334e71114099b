"""Gates, sensor check and error statistics of many axes at once, as operations of torch that write nothing.

The single learner's forms are ``adaptive.online.gates``, ``intake``, ``sensor_trust`` and ``learner``; thresholds are
imported from there. Results are what the entries of the state become if the sample is taken.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from adaptive.fleet.state import OUTCOMES, AxisConstants, BatchState
from adaptive.online import gates, intake, learner, sensor_trust

CODE = {name: number for number, name in enumerate(OUTCOMES)}
#: No gate has refused the sample.
OPEN = -1
New = dict[str, Tensor]


class Admitted(NamedTuple):
    """refused (B,) : number of the gate, or OPEN. doubt (B,) : whether the sample is not an ordinary one. control (B,)
    : whether a control trial is due. new : entries of the state."""

    refused: Tensor
    doubt: Tensor
    control: Tensor
    new: New


def admit(c: AxisConstants, s: BatchState, seq: Tensor, t_s: Tensor, u_V: Tensor, y_um: Tensor) -> Admitted:
    """What the intake does with one sample of each axis; see `Intake.take`."""
    config = c.config.learner.admission.at(c.dt_s)
    g = {name: s[f"front.gates.{name}"] for name in (
        "seq", "t_s", "since_start", "since_step", "since_glitch", "u_V", "u_before_V", "kink_V", "innovation2",
        "y_um", "same", "low_V", "high_V")}  # fmt: skip
    sound = torch.isfinite(t_s) & (u_V.abs() < gates.ABSURD)
    ahead = seq - g["seq"]
    expected = ahead * c.dt_s
    timing = (t_s - g["t_s"] - expected).abs() > config.timing_tolerance * expected
    refused = torch.full_like(seq, OPEN)
    far = (y_um - c.middle_um).abs() > intake.FAR_OUT * c.range_um
    late = (ahead <= 0) | timing
    for gate, where in (
        (gates.OUT_OF_RANGE, far),
        (gates.TIMING, timing),
        (gates.OUT_OF_ORDER, ahead < 0),
        (gates.DUPLICATE, ahead == 0),
        (gates.NOT_FINITE, ~(sound & (y_um.abs() < gates.ABSURD))),
    ):
        refused = torch.where(where, CODE[gate], refused)
    # The voltage of a sample in its place without a reading is kept by the single learner.
    doubt = (refused != OPEN) & sound & ~late
    doubt |= (refused == OPEN) & (ahead > 1)
    new: New = {"seq": seq, "t_s": t_s, "since_glitch": g["since_glitch"] + 1, "u_V": u_V, "u_before_V": g["u_V"]}
    kink = (u_V - 2.0 * g["u_V"] + g["u_before_V"]).abs()
    new["since_step"] = torch.where(kink > 0.25 * config.glitch_share * c.span_V, 0, g["since_step"] + 1)
    new["kink_V"] = torch.maximum(kink, gates.KINK_DECAY * g["kink_V"])
    differs, spread = y_um != g["y_um"], g["innovation2"].sqrt()
    new["y_um"], new["same"] = y_um, torch.where(differs, 1, g["same"] + 1)
    new["low_V"] = torch.where(differs, u_V, torch.minimum(g["low_V"], u_V))
    new["high_V"] = torch.where(differs, u_V, torch.maximum(g["high_V"], u_V))
    moved = new["high_V"] - new["low_V"] > (gates.STUCK_SIGMA * spread).clamp(min=gates.STUCK_SHARE) * c.span_V
    stuck = ~differs & (new["same"] >= gates.REPEATED) & moved
    innovation = ((y_um - s["front.track.smoother.x"][:, 0]) / c.range_um).abs()
    known = g["since_start"] > config.settle
    usual = (config.surprise_sigma * spread).clamp(config.surprise_share, config.glitch_share)
    limit = usual + gates.KINK_SHARE * new["kink_V"] / c.span_V
    doubt |= (refused == OPEN) & (stuck | (known & ((innovation > limit) | _lags(c, s, seq, y_um, spread))))
    most = (gates.FAR_RMS * spread).clamp(min=config.surprise_share / config.surprise_sigma)
    error = torch.minimum(innovation, most)
    new["innovation2"] = g["innovation2"] + (error * error - g["innovation2"]) / gates.INNOVATION_SAMPLES
    new["since_start"], new["since_jump"] = g["since_start"] + 1, s["front.gates.since_jump"] + 1
    new = {f"front.gates.{name}": value for name, value in new.items()}
    new["front.calm"], new["front.until_control"] = s["front.calm"] + 1, s["front.until_control"] - 1
    control = (refused == OPEN) & ~doubt & known & c.tells & (new["front.until_control"] <= 0)
    return Admitted(refused, doubt, control, new)


def _lags(c: AxisConstants, s: BatchState, seq: Tensor, y_um: Tensor, spread: Tensor) -> Tensor:
    """Whether the reading has not moved with the voltage, by a rough measure; see there."""
    every = max(1, round(intake.LOOK_S / c.dt_s))
    looks = (seq % every == 0) & c.tells & (s["front.credit"] > 0) & (s["past.count"] > 0)
    looks &= s["front.gates.since_start"] >= s["front.look_from"]
    lag, slots = c.sizes["lag"], c.sizes["lag"] + 2
    last = s["front.track.smoother.count"] - 1
    voltages, readings = s["front.track.u_V"], s["front.track.y_um"]
    du = (voltages.gather(1, (last % slots)[:, None]) - voltages.gather(1, ((last - lag) % slots)[:, None]))[:, 0]
    dy = y_um - readings.gather(1, ((last - lag + 1) % slots)[:, None])[:, 0]
    x = du / c.slope_V_per_um
    large = (x.abs() > intake.LAGS_SHARE * c.range_um) & (x.abs() > intake.LAGS_SIGMA * spread * c.range_um)
    ratio = dy / x
    return looks & large & ~((ratio >= intake.LAGS[0]) & (ratio <= intake.LAGS[1]))


def follow(
    c: AxisConstants, s: BatchState, axes: Tensor, u_V: Tensor, p_V: Tensor, since_s: float
) -> tuple[Tensor, New]:
    """(k,) whether the last steps of ``axes`` show a sensor fault, and the check's entries; see `Following.take`."""
    t, span = sensor_trust, c.drive_V[axes]
    names = ("u_V", "p_V", "steps", "count", "driven", "uu", "pp", "up", "good", "still", "last_V", "noise2")
    f = {name: s[f"front.following.{name}"][axes] for name in names}
    steps, last = f["steps"] + 1, p_V - u_V
    change, floor = last - f["last_V"], t.STEP_SHARE * span
    cap = 16.0 * f["noise2"] + floor**2
    noise2 = f["noise2"] + (torch.minimum(change * change, cap) - f["noise2"]) / t.NOISE_PAIRS
    noise2 = torch.where(change.isnan(), f["noise2"], noise2)
    du, dp = u_V - f["u_V"], p_V - f["p_V"]
    begins = du.isnan() | dp.isnan()
    size = torch.maximum(du.abs(), dp.abs())
    step_V = torch.maximum(floor, t.STEP_SIGMA * noise2.sqrt())
    ends = ~begins & (size >= step_V) & (steps * since_s >= t.STEP_S)
    counts = ends & (size >= t.CREEP_PER_S * span * steps * since_s)
    anew = begins | ends
    u, p = du / size, dp / size

    def summed(name: str, value: Tensor) -> Tensor:
        return torch.where(counts, t.FORGET * f[name] + value, f[name])

    moves = u.abs()
    still = torch.where(counts, torch.where(p.abs() <= t.STEP_STILL * moves, f["still"] + 1, 0), f["still"])
    count, uu, pp, up = summed("count", 1.0 + 0.0 * u), summed("uu", u * u), summed("pp", p * p), summed("up", u * p)
    driven = summed("driven", (moves >= t.STEP_STILL).to(u.dtype))
    judged = counts & (count >= t.ENOUGH) & (driven >= t.OF_VOLTAGE * count)
    slope, straight = up / uu, torch.where(pp > 0.0, up * up / (uu * pp), 0.0)
    low, high = t.FOLLOWING_SLOPES
    odd = (count >= t.ENOUGH_SLOPE) & ~((slope >= low) & (slope <= high))
    fault = judged & torch.where(straight < t.FOLLOWING_STRAIGHT, pp <= high**2 * uu, odd)
    good = torch.where(judged, torch.where(fault, 0, f["good"] + 1), f["good"])
    new = {
        "u_V": torch.where(anew, u_V, f["u_V"]), "p_V": torch.where(anew, p_V, f["p_V"]),
        "steps": torch.where(anew, 0, steps), "count": count, "driven": driven, "uu": uu, "pp": pp, "up": up,
        "good": good, "still": still, "last_V": last, "noise2": noise2,
    }  # fmt: skip
    return fault | (judged & (still >= t.STILL_STEPS)), {f"front.following.{name}": new[name] for name in names}


def judge(c: AxisConstants, s: BatchState, axes: Tensor, error: Tensor, frozen_error: Tensor) -> tuple[Tensor, New]:
    """(k,) whether the filter has to return to a mark, and the error statistics; see `Parts.judge`."""
    config, span, step_s = c.config.learner, c.span_V[axes], c.step_s
    names = ("long_V2", "short_V2", "frozen_V2", "frozen_short_V2", "judged", "inside", "valid", "fallback", "fallen_s",
             "doubt_V2")  # fmt: skip
    j = {name: s[f"judgement.{name}"][axes] for name in names}
    slow, fast = min(1.0, step_s / learner.LONG_S), min(1.0, step_s / learner.SHORT_S)
    squared, frozen = error * error, frozen_error * frozen_error
    variance = torch.maximum(j["long_V2"], j["short_V2"]) + j["doubt_V2"]
    new = {"error_V": error, "judged": j["judged"] + 1, "doubt_V2": j["doubt_V2"] * (1.0 - fast)}
    new["inside"] = j["inside"] + ((j["judged"] > 0) & (squared <= variance))
    for name, value, rate in (
        ("long_V2", squared, slow), ("short_V2", squared, fast),
        ("frozen_V2", frozen, slow), ("frozen_short_V2", frozen, fast),
    ):  # fmt: skip
        new[name] = j[name] + (value - j[name]) * rate
    learnt, other = new["short_V2"].sqrt(), new["frozen_short_V2"].sqrt()
    new["valid"] = torch.where(j["valid"], ~(learnt > config.valid_leave * span), learnt < config.valid_enter * span)
    worse = learnt > learner.FALLBACK_RATIO * other + config.fallback_floor * span
    new["fallback"] = torch.where(j["fallback"], ~(learnt < other), worse)
    new["fallen_s"] = torch.where(new["fallback"], j["fallen_s"] + step_s, 0.0)
    entries = {f"judgement.{name}": value for name, value in new.items()}
    entries["events.fallbacks"] = s["events.fallbacks"][axes] + (new["fallback"] & ~j["fallback"])
    return new["fallen_s"] > learner.ROLLBACK_S, entries


def watch(
    c: AxisConstants, s: BatchState, axes: Tensor, away_V: Tensor, saturated: Tensor, short_V2: Tensor, checks_s: float
) -> tuple[Tensor, New]:
    """(k,) whether the learner has to begin again; see `Parts.watch_shape` and ``watch_rail``."""
    allowed, left, rail = c.allowed_V[axes], s["left_s"][axes], s["rail_s"][axes]
    outside = (allowed > 0.0) & (away_V.abs() > allowed)
    left = torch.where(
        outside, left.clamp(min=0.0) + checks_s, (left.clamp(max=0.0) - checks_s).clamp(min=-learner.LEFT_S)
    )
    rail = torch.where(
        saturated,
        (rail.clamp(min=0.0) + checks_s).clamp(max=learner.RAIL_S),
        (rail.clamp(max=0.0) - checks_s).clamp(min=-learner.RAIL_S),
    )
    wrong = short_V2 > (learner.RAIL_SHARE * c.span_V[axes]) ** 2
    again = (outside & (left >= learner.RAIL_S)) | (saturated & (rail >= learner.RAIL_S) & wrong)
    return again, {"left_s": left, "rail_s": rail}
