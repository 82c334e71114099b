"""A client written from docs/protocol.md alone: struct, json, zlib, hashlib and numpy, and nothing of this project.

`decode_query`, `decode_reply`, `decode_model` read payloads, `Changes` sums up model changes; `Model` evaluates every
kind; `answer` gives the reply to a query as the service does, by the page's sections "Evaluating a model" and "Limits,
stand-in and flags".
"""

from __future__ import annotations

import hashlib
import hmac
import json
import math
import os
import struct
import zlib
from typing import Any

import numpy as np

# --- The authenticator.


def tag(secret: bytes, *parts: bytes | str) -> bytes:
    """Of the parts of a message, under the key of the service."""
    text = [part.encode() if isinstance(part, str) else part for part in parts]
    data = b"".join(struct.pack("<Q", len(part)) + part for part in text)
    return hashlib.blake2b(data, key=secret, digest_size=16).digest()


class Trust:
    """What a client believes: `replies` of its own queries, and `publications` of who answered them, in order."""

    def __init__(self, secret: bytes) -> None:
        self.secret, self.sender, self.number = secret, b"", -1

    def reply(self, key: str, stamp: bytes, parameters: str, asked: bytes, attached: bytes, payload: bytes) -> bool:
        """Whether this answers the query that was sent with ``stamp``."""
        right = tag(self.secret, "reply", key, attached[:16], stamp, parameters, asked, payload)
        if not hmac.compare_digest(attached[16:], right):
            return False
        if key.endswith("/model"):  # what is published from now on follows this
            self.sender, self.number = attached[:8], int.from_bytes(attached[8:16], "little")
        return True

    def publication(self, key: str, attached: bytes, payload: bytes) -> bool:
        """Whether this is said by who answered, and for the first time."""
        right = tag(self.secret, "put", key, attached[:16], payload)
        number = int.from_bytes(attached[8:16], "little")
        if not hmac.compare_digest(attached[16:], right) or attached[:8] != self.sender or number <= self.number:
            return False
        self.number = number
        return True


class Stage:
    """Signs what a stage publishes."""

    def __init__(self, secret: bytes) -> None:
        self.secret, self.sender, self.number = secret, os.urandom(8), 0

    def attachment(self, key: str, payload: bytes) -> bytes:
        """Of the next message."""
        self.number += 1
        stamp = self.sender + struct.pack("<Q", self.number)
        return stamp + tag(self.secret, "put", key, stamp, payload)


# --- Payloads.


def decode_query(data: bytes) -> dict[str, Any]:
    """A payload of kind 4."""
    version, kind, options, n = struct.unpack_from("<BBHI", data, 0)
    assert (version, kind) == (1, 4)
    as_of, u_before_V, m, b = struct.unpack_from("<qdII", data, 8)
    c = 3 if options & 1 else 2
    doubles = list(struct.unpack_from(f"<{m + c * n}d", data, 32))
    at = 32 + 8 * (m + c * n) + b
    query = {
        "as_of": as_of, "u_before_V": u_before_V, "memory": doubles[:m] if options & 2 else None,
        "y": doubles[m : m + n], "v": doubles[m + n : m + 2 * n], "a": doubles[m + 2 * n :] or [0.0] * n,
        "model": data[at - b : at].decode(), "pending": None,
    }  # fmt: skip
    if options & 4:
        first, k = struct.unpack_from("<qI", data, at)
        way = struct.unpack_from(f"<{2 * k}d", data, at + 12)
        query["pending"] = first, list(way[:k]), list(way[k:])
        at += 12 + 16 * k
    assert at == len(data)
    return query


def decode_reply(data: bytes) -> dict[str, Any]:
    """A payload of kind 5."""
    version, kind, options, n = struct.unpack_from("<BBHI", data, 0)
    assert (version, kind) == (1, 5)
    snapshot_seq, m, b = struct.unpack_from("<qII", data, 8)
    assert len(data) == 24 + 16 * n + 8 * m + n + b
    doubles = struct.unpack_from(f"<{2 * n + m}d", data, 24)
    flags = list(data[24 + 16 * n + 8 * m :][:n])
    name = data[len(data) - b :].decode()
    return {
        "options": options, "snapshot_seq": snapshot_seq, "u_V": doubles[:n], "std_V": doubles[n : 2 * n],
        "memory": list(doubles[2 * n :]), "flags": flags, "model": name,
    }  # fmt: skip


def decode_model(data: bytes) -> dict[str, Any]:
    """A payload of kind 6: its JSON, with the arrays as lists under ``data`` and the number ``snapshot_seq``."""
    version, kind, options, n = struct.unpack_from("<BBHI", data, 0)
    assert (version, kind, options) == (1, 6, 0)
    snapshot_seq, j, b = struct.unpack_from("<qII", data, 8)
    assert len(data) == 24 + j + b
    assert j % 8 == 0
    text = json.loads(data[24 : 24 + j])
    assert len(text["arrays"]) == n
    formats = {"<f8": "d", "<f4": "f", "<i8": "q", "<i4": "i", "|u1": "B", "|b1": "?"}
    arrays, at = {}, 24 + j
    for name, dtype, shape in text["arrays"]:
        assert at % 8 == 0
        layout = f"<{math.prod(shape)}{formats[dtype]}"
        values = list(struct.unpack_from(layout, data, at))
        arrays[name] = values if shape else values[0]
        at += -(-struct.calcsize(layout) // 8) * 8
    assert at == len(data)
    return {**text, "data": arrays, "snapshot_seq": snapshot_seq}


def decode_plain(data: bytes) -> dict[str, list[float]]:
    """The values of a payload of kind 1, 2 or 3 by field."""
    version, kind, options, n = struct.unpack_from("<BBHI", data, 0)
    assert (version, options) == (1, 0)
    if kind == 1:
        assert len(data) == 8 + 32 * n
        columns = [list(struct.unpack_from(f"<{n}{t}", data, 8 + 8 * n * i)) for i, t in enumerate("qddd")]
        return dict(zip(("seq", "t_s", "u_V", "y_um"), columns, strict=True))
    assert len(data) == 16 + 8 * n
    values = list(struct.unpack_from(f"<{n}d", data, 16))
    return {"seq": list(struct.unpack_from("<q", data, 8)), {2: "u_V", 3: "y_um"}[kind]: values}


def decode_fleet(data: bytes) -> tuple[int, dict[str, list[float]]]:
    """(first axis, values in order by name) of a payload of kind 8 to 11."""
    version, kind, options, b, first, k, m = struct.unpack_from("<BBHIIII", data, 0)
    assert version == 1
    assert options == 0 or kind == 9
    matrix, memory = ("d", k * b), ("d", b * m)
    follows = {
        8: {"seq": ("q", k), "t_s": ("d", k), "u_V": matrix, "y_um": matrix},
        9: {"y_um": matrix, "v_um_per_s": matrix, "a_um_per_s2": matrix}
        | ({"memory": memory} if options & 1 else {})
        | ({"u_before_V": ("d", b)} if options & 2 else {}),
        10: {"snapshot_seq": ("q", 1), "u_V": matrix, "std_V": matrix, "memory": memory, "flags": ("B", k * b)},
        11: {"snapshot_seq": ("q", 1), "axes": ("q", b), "frames": ("d", 2 * b), "beta": memory},
    }[kind]
    at, values = 20, {}
    for name, (letter, count) in follows.items():
        values[name] = list(struct.unpack_from(f"<{count}{letter}", data, at))
        at += struct.calcsize(f"<{count}{letter}")
    assert at == len(data)
    return first, values


# --- Changes of a model.


class Changes:
    """A whole model and its newest change: `take` takes messages and says what became of them."""

    def __init__(self) -> None:
        self.base = 0
        self._whole: dict[str, Any] = {}
        self._change: tuple[int, list[float], list[float]] | None = None
        self._left = bytes(24)

    def take(self, data: bytes) -> str:
        """A payload of kind 6 or 7."""
        if data[1] == 6:
            self._whole, self.base, self._change = decode_model(data), zlib.crc32(data), None
            if struct.unpack_from("<I", self._left, 16)[0] == self.base:
                self.take(self._left)
            return "taken"
        version, kind, options, p, seq, base, m = struct.unpack_from("<BBHIqII", data)
        assert (version, kind, options, len(data)) == (1, 7, 0, 24 + 8 * (9 + p + m))
        if base != self.base:
            self._left = data
            return "lost"
        values = list(struct.unpack_from(f"<{9 + p + m}d", data, 24))
        moving, memory = values[: 9 + p], values[9 + p :]
        known, prefix = self._whole["data"], self._prefix()
        if f"{prefix}alpha" not in known or (p, m) != (len(known[f"{prefix}beta"]), len(known["/memory"])):
            return "refused"
        if not all(map(math.isfinite, moving)) or moving[2] < 0.0:
            return "refused"
        self._change = seq, moving, memory
        return "taken"

    def model(self) -> dict[str, Any]:
        """The model as `decode_model` gives it."""
        if self._change is None:
            return self._whole
        (seq, moving, memory), prefix = self._change, self._prefix()
        names = ("features.gain", "features.offset_um", "noise_variance")
        values = self._whole["values"] | {prefix + name: value for name, value in zip(names, moving[:3], strict=True)}
        data = self._whole["data"] | {f"{prefix}domain": moving[3:9], f"{prefix}beta": moving[9:], "/memory": memory}
        return {**self._whole, "values": values, "data": data, "snapshot_seq": seq}

    def _prefix(self) -> str:
        """Begin of the names of what moves: in a champion, its own name."""
        values = self._whole["values"]
        return f"{values['names'].split(',')[values['champion']]}." if self._whole["kind"] == "champion" else ""


# --- Models. Each gives (voltages, deviations, inside, memory after the last point) for n points.

Forward = tuple[list[float], list[float], list[bool], list[float]]


class Model:
    """A model of any kind from its ``values`` and arrays, in one dictionary."""

    def __init__(self, kind: str, entries: dict[str, Any], dt_s: float) -> None:
        self.kind, self.dt_s, self.f = kind, dt_s, {k.removeprefix("features."): v for k, v in entries.items()}
        # Contestants have features of their own.
        self.contestants = []
        if kind == "champion":
            for name, own in zip(entries["names"].split(","), entries["kinds"].split(","), strict=True):
                inner = {k.removeprefix(f"{name}."): v for k, v in entries.items() if k.startswith(f"{name}.")}
                self.contestants.append(Model(own, inner, dt_s))

    @property
    def memory_size(self) -> int:
        f = self.f
        if self.kind == "lssvm":
            arcs = len(f["arc_lengths_um"])
            return len(f["thresholds_um"]) + arcs + len(f["time_constants_s"]) + (arcs > 0)
        if self.kind == "champion":
            return len(self.contestants) + sum(model.memory_size for model in self.contestants)
        return {"linear": 0, "bouc_wen": 2, "mpi": len(f.get("r_V", ()))}[self.kind]

    def evaluate(self, y: list[float], v: list[float], a: list[float], memory: list[float]) -> Forward:
        assert len(memory) == self.memory_size
        u, std, inside, after = getattr(self, f"_{self.kind}")(y, v, a, list(memory))
        if self.kind != "champion" and not all(map(math.isfinite, after)):
            after = list(memory)
        return u, std, inside, after

    def advance(self, y: list[float], u: list[float], memory: list[float]) -> list[float]:
        """The memory after a motion that was commanded by ``u``."""
        after, f = list(memory), self.f
        for y_um, u_V in zip(y, u, strict=True):
            if self.kind == "lssvm":
                self._frame_and_memory(y_um, after)
            elif self.kind == "bouc_wen":
                after = [u_V, self._hysteresis(*after, u_V)]
            elif self.kind == "mpi":
                after = [max(u_V - r, min(u_V + r, z)) for r, z in zip(f["r_V"], after, strict=True)]
        if self.kind == "champion":
            shares, parts = self._split(memory)
            ends = [model.advance(y, u, part) for model, part in zip(self.contestants, parts, strict=True)]
            after = [*self._weights(shares, len(y)), *(value for end in ends for value in end)]
        return after

    def _linear(self, y: list[float], v: list[float], a: list[float], memory: list[float]) -> Forward:
        f, inside = self.f, [self._within(y_um) for y_um in y]
        # Division by a gain near 0 overflows to infinity.
        u = [float(np.divide(y_um - f["offset_um"], np.float64(f["gain_um_per_V"]))) for y_um in y]
        return u, [f["voltage_std_V"]] * len(y), inside, memory

    def _within(self, y: float, v: float = 0.0) -> bool:
        return bool(self.f["y_min_um"] <= y <= self.f["y_max_um"] and abs(v) <= self.f["v_max_um_per_s"])

    # lssvm

    def _frame_and_memory(self, y: float, memory: list[float]) -> float:
        """Steps 1 and 2; ``memory`` advances in place. Returns q."""
        f = self.f
        q = (y - f["offset_um"]) / f["gain"]
        plays, arcs, slow = f["thresholds_um"], f["arc_lengths_um"], f["time_constants_s"]
        k, n_arcs = len(plays), len(arcs)
        for i, r in enumerate(plays):
            memory[i] = max(q - r, min(q + r, memory[i]))
        z = max(q - f["dead_um"], min(q + f["dead_um"], memory[-1])) if arcs else 0.0
        for i, rho in enumerate(arcs):
            memory[k + i] = q + (memory[k + i] - q) * math.exp(-abs(z - memory[-1]) / rho)
        for i, tau in enumerate(slow):
            memory[k + n_arcs + i] = q + (memory[k + n_arcs + i] - q) * math.exp(-self.dt_s / tau)
        if arcs:
            memory[-1] = z
        return float(q)

    def _lssvm(self, y: list[float], v: list[float], a: list[float], memory: list[float]) -> Forward:
        f, n = self.f, len(self.f["alpha"])
        plays, arcs, slow = f["thresholds_um"], f["arc_lengths_um"], f["time_constants_s"]
        k, n_arcs = len(plays), len(arcs)
        h = (f["y_max_um"] - f["y_min_um"]) / 2
        lows, highs = f["domain"][::2], f["domain"][1::2]
        u, std, inside = [], [], []
        for point in zip(y, v, a, strict=True):
            q = self._frame_and_memory(point[0], memory)
            yn = (q - f["y_min_um"] - h) / h
            vn, an = point[1] / f["gain"] / f["v_scale_um_per_s"], point[2] / f["gain"] / f["a_scale_um_per_s2"]
            p = [(q - memory[i]) / r for i, r in enumerate(plays)]
            basis = [1.0]
            if f["linear"]:
                basis += [yn, vn, an, yn**2, yn**3, *p, *([yn * value for value in p] if f["asymmetric"] else [])]
                basis += [(q - memory[k + i]) / rho for i, rho in enumerate(arcs)]
                basis += [(q - memory[k + n_arcs + i]) / h for i in range(len(slow))]
            x = [yn, vn, *(p[i] for i in f["kernel_plays"])]
            support = np.array(f["support"]).reshape(n, len(x))
            kernel = np.exp(-np.sum(((np.array(x) - support) / f["widths"]) ** 2, axis=1))
            voltage = math.fsum(b * c for b, c in zip(f["beta"], basis, strict=True)) + math.fsum(f["alpha"] * kernel)
            if f.get("anchor"):
                known = math.fsum(b * c for b, c in zip(f["anchor"], basis, strict=True))
                voltage = min(max(voltage, known - f["allowed_V"]), known + f["allowed_V"])
            nearest = float(kernel.max()) if n else 0.0
            variance = f["noise_variance"] + f["kernel_variance"] * (1.0 - nearest**2 / (1.0 + 1.0 / f["gamma"]))
            if f["beta_covariance"]:
                covariance = np.array(f["beta_covariance"]).reshape(len(basis), len(basis))
                variance += float(np.array(basis) @ covariance @ np.array(basis))
            u.append(voltage)
            std.append(math.sqrt(max(variance, 0.0)))
            inside.append(
                all(
                    low - 0.05 * (high - low) <= value <= high + 0.05 * (high - low)
                    for low, high, value in zip(lows, highs, point, strict=True)
                )
            )
        return u, std, inside, memory

    # bouc_wen

    def _stretch(self, q: float, s: float, c: float) -> float:
        alpha = self.f["alpha"]
        return float(q + alpha * s if abs(c) < 1e-7 else q + (alpha / c - q) * -math.expm1(-c * s))

    def _zero(self, q: float, c: float) -> float:
        """s after which q < 0 has reached 0."""
        alpha = self.f["alpha"]
        if alpha == 0.0 or (abs(c) >= 1e-7 and q * c / alpha >= 1.0):
            return math.inf
        return float(-q / alpha if abs(c) < 1e-7 else math.log1p(-q * c / alpha) / c)

    def _hysteresis(self, u0: float, g0: float, u: float) -> float:
        beta, gamma = self.f["beta_per_V"], self.f["gamma_per_V"]
        e, s = (1.0 if u > u0 else -1.0), abs(u - u0)
        q = e * g0
        if q < 0.0:
            s0 = self._zero(q, beta - gamma)
            if s < s0:
                return e * self._stretch(q, s, beta - gamma)
            q, s = 0.0, s - s0
        return e * self._stretch(q, s, beta + gamma)

    def _bouc_wen(self, y: list[float], v: list[float], a: list[float], memory: list[float]) -> Forward:
        f = self.f
        lag, inertia = f["b_N_s_per_m"] / f["k_N_per_m"], f["m_kg"] / f["k_N_per_m"]
        ahead = self.dt_s / 2 if f["hold"] == "zero_order" else 0.0
        bound = f["alpha"] / (f["beta_per_V"] + f["gamma_per_V"])
        u0, g0 = memory[0], max(-bound, min(bound, memory[1]))
        u = []
        for y_um, v_um_per_s, a_um_per_s2 in zip(y, v, a, strict=True):
            lead = (lag + ahead) * v_um_per_s + (inertia + lag * ahead + ahead**2 / 2) * a_um_per_s2
            w = (y_um - f["offset_um"] + lead) / f["d_um_per_V"]
            u1 = self._root(u0, g0, w)
            u0, g0 = u1, self._hysteresis(u0, g0, u1)
            u.append(u0)
        inside = [self._within(*point) for point in zip(y, v, strict=True)]
        return u, [f["voltage_std_V"]] * len(y), inside, [u0, g0]

    def _root(self, u0: float, g0: float, w: float) -> float:
        """The root of u - g(u) = w, which rises with u: by bisection, unlike the service."""
        step = 1.0 if w > u0 - g0 else -1.0
        low, high = u0, u0 + step
        while step * (high - self._hysteresis(u0, g0, high) - w) < 0.0:
            high += step * max(1.0, abs(high - u0))
        for _ in range(200):
            middle = 0.5 * (low + high)
            if middle in (low, high):
                break
            if step * (middle - self._hysteresis(u0, g0, middle) - w) < 0.0:
                low = middle
            else:
                high = middle
        return high

    # mpi

    @staticmethod
    def _inverted(weights: list[float], thresholds: list[float]) -> tuple[list[float], list[float], list[float]]:
        """(partial sums, weights, thresholds) of the inverse operator."""
        sums = [math.fsum(weights[: i + 1]) for i in range(len(weights))]
        w = [1.0 / weights[0], *(-weights[i] / (sums[i] * sums[i - 1]) for i in range(1, len(weights)))]
        moments = [math.fsum(weights[j] * thresholds[j] for j in range(i + 1)) for i in range(len(weights))]
        return sums, w, [sums[i] * r - moments[i] for i, r in enumerate(thresholds)]

    def _mpi(self, y: list[float], v: list[float], a: list[float], memory: list[float]) -> Forward:
        f = self.f
        w_h = f["w_h"]
        sums, w_star, r_star = self._inverted(w_h, f["r_V"])
        _, ws_star, d_star = self._inverted(f["w_s"], f["d_um"])
        n = len(w_h)
        z = [sums[i] * memory[i] + math.fsum(w_h[j] * memory[j] for j in range(i + 1, n)) for i in range(n)]
        u = []
        for y_um, v_um_per_s in zip(y, v, strict=True):
            x = y_um - f["y_ref_um"] + f["lag_s"] * v_um_per_s
            p = math.fsum(w * (x if d <= 0.0 else max(x - d, 0.0)) for w, d in zip(ws_star, d_star, strict=True))
            p -= f["c_um"]
            z = [max(p - r, min(p + r, value)) for r, value in zip(r_star, z, strict=True)]
            u.append(math.fsum(w * value for w, value in zip(w_star, z, strict=True)))
        after = [0.0] * n
        after[-1] = z[-1] / sums[-1]
        for i in range(n - 2, -1, -1):
            after[i] = after[i + 1] + (z[i] - z[i + 1]) / sums[i]
        inside = [self._within(*point) for point in zip(y, v, strict=True)]
        return u, [f["voltage_std_V"]] * len(y), inside, after

    # champion

    def _split(self, memory: list[float]) -> tuple[list[float], list[list[float]]]:
        """(shares, memory of each contestant)."""
        k = len(self.contestants)
        shares, rest, parts = memory[:k], memory[k:], []
        for model in self.contestants:
            parts.append(rest[: model.memory_size])
            rest = rest[model.memory_size :]
        if not (all(math.isfinite(s) and s >= 0.0 for s in shares) and sum(shares) > 0.0):
            shares = [float(i == self.f["champion"]) for i in range(k)]
        return [s / sum(shares) for s in shares], parts

    def _weights(self, shares: list[float], i: int) -> list[float]:
        """Weights at point ``i``, from 1 on."""
        c, blend_s = self.f["champion"], self.f["blend_s"]
        s = shares[c]
        if i == 0:
            return shares
        if s >= 1.0 or blend_s == 0.0:
            return [float(j == c) for j in range(len(shares))]
        w = min(1.0, s + i * self.dt_s / blend_s)
        return [w if j == c else share * (1.0 - w) / (1.0 - s) for j, share in enumerate(shares)]

    def _champion(self, y: list[float], v: list[float], a: list[float], memory: list[float]) -> Forward:
        shares, parts = self._split(memory)
        c, n = self.f["champion"], len(y)
        answers = {
            j: model.evaluate(y, v, a, parts[j])
            for j, model in enumerate(self.contestants)
            if j == c or shares[j] > 0.0
        }
        u, std, inside, _ = answers[c]
        if len(answers) > 1:
            u, std, inside = [], [], []
            for i in range(n):
                weights = self._weights(shares, i + 1)
                own = {j: got[0][i] if math.isfinite(got[0][i]) else answers[c][0][i] for j, got in answers.items()}
                mean = math.fsum(weights[j] * own[j] for j in answers)
                weighing = [j for j in answers if weights[j] > 0.0]
                u.append(mean)
                std.append(
                    math.sqrt(math.fsum(weights[j] * (answers[j][1][i] ** 2 + (own[j] - mean) ** 2) for j in weighing))
                )
                inside.append(all(answers[j][2][i] for j in weighing))
        ends = []
        for j, model in enumerate(self.contestants):
            end = answers[j][3] if j in answers else model.advance(y, u, parts[j])
            ends.append(end if all(map(math.isfinite, end)) else parts[j])
        return u, std, inside, [*self._weights(shares, n), *(value for end in ends for value in end)]

    def weight(self, y: float, v: float, a: float, blend_share: float) -> float:
        """Weight by distance from the domain."""
        model = self.contestants[self.f["champion"]] if self.kind == "champion" else self
        if model.kind != "lssvm":
            return 1.0
        d = 0.0
        for low, high, x in zip(model.f["domain"][::2], model.f["domain"][1::2], (y, v, a), strict=True):
            margin = 0.05 * (high - low)
            d = max(d, (low - margin - x) / (1.1 * (high - low)), (x - high - margin) / (1.1 * (high - low)))
        s = min(1.0, d / blend_share)
        return 1.0 - s * s * (3.0 - 2.0 * s)


# --- The answer to a query.

LIMITED_VOLTAGE, LIMITED_SLEW, OUTSIDE, NOT_FINITE, BLENDED, STAND_IN, STALE = 1, 2, 4, 8, 16, 32, 64
Limits = tuple[float, float, float]


def answer(
    message: dict[str, Any],
    query: dict[str, Any],
    limits: Limits = (0.0, 10.0, math.inf),
    age_s: float = math.nan,
) -> dict[str, Any]:
    """u_V, std_V, flags, memory and model of the reply to a query; ``limits``: u_min_V, u_max_V, slew_V_per_s."""
    model = Model(message["kind"], message["values"] | message["data"], message["dt_s"])
    memory = query["memory"] if query["memory"] is not None else message["data"]["/memory"]
    y, v, a, dt = query["y"], query["v"], query["a"], message["dt_s"]
    if query["pending"] is None or query["pending"][0] + len(query["pending"][1]) <= message["snapshot_seq"]:
        return _safely(message, model, (y, v, a), memory, limits, query["u_before_V"], age_s)
    first, y_p, u_p = query["pending"]
    s = min(max(message["snapshot_seq"] + 1 - first, 0), len(y_p) - 1)
    memory = model.advance(y_p[s:-1], u_p[s:-1], memory)
    p, j = y_p[-1], 6.0 * (y[0] - v[0] * dt + a[0] * dt**2 / 2.0 - y_p[-1]) / dt**3
    pairs = [(v[0] - a[0] * dt + j * dt**2 / 2.0, a[0] - j * dt)]
    if len(y_p) > 1:
        pairs.append(((p - y_p[-2]) / dt, 0.0))
    if len(y_p) > 2:
        pairs.append(((y[0] - y_p[-2]) / (2.0 * dt), (v[0] - (p - y_p[-3]) / (2.0 * dt)) / (2.0 * dt)))
    errors = [abs(model.evaluate([p], [one_v], [one_a], memory)[0][0] - u_p[-1]) for one_v, one_a in pairs]
    errors = [error if math.isfinite(error) else math.inf for error in errors]
    last_v, last_a = pairs[errors.index(min(errors))]
    points = [p, *y], [last_v, *v], [last_a, *a]
    got = _safely(message, model, points, memory, (*limits[:2], math.inf), math.nan, age_s)
    gap, T = u_p[-1] - got["u_V"][0], max(0.006, 6.0 * dt)
    faded = [u + gap * math.exp(-i * dt / T) for i, u in enumerate(got["u_V"])]
    marks, before_V = got["flags"], query["u_before_V"]
    u, flags = _limited(faded[1:], [not mark & OUTSIDE for mark in marks[1:]], dt, limits, before_V)
    flags = [mark | flag for mark, flag in zip(marks[1:], flags, strict=True)]
    return got | {"u_V": u, "std_V": got["std_V"][1:], "flags": flags}


def _safely(
    message: dict[str, Any],
    model: Model,
    points: tuple[list[float], list[float], list[float]],
    memory: list[float],
    limits: Limits,
    u_before_V: float,
    age_s: float,
) -> dict[str, Any]:
    safety = message.get("safety", {"blends": False, "trust": 1.0, "stale_s": 0.0})
    u, std, inside, after = model.evaluate(*points, memory)
    trust, stale = safety["trust"], safety["stale_s"] > 0.0 and age_s > safety["stale_s"]
    if stale:
        trust *= 1.0 - min(1.0, max(0.0, age_s - safety["last_good_s"]))
    blends, finite = safety["blends"], [math.isfinite(value) for value in u]
    marks, name = [0] * len(u), message["name"]
    if not all(finite) or (blends and (trust < 1.0 or not all(inside))):
        if "stand_in" in safety:
            other = safety["stand_in"]
            entries = {
                k.removeprefix("/stand_in/"): x for k, x in message["data"].items() if k.startswith("/stand_in/")
            }
            stand_in = Model(other["kind"], other["values"] | entries, message["dt_s"])
            there, there_std, _, _ = stand_in.evaluate(*points, message["data"]["/stand_in_memory"])
            for i, point in enumerate(zip(*points, strict=True)):
                w = trust * (1.0 if inside[i] else model.weight(*point, safety["blend_share"])) if blends else 1.0
                w = w if finite[i] else 0.0
                w = w if math.isfinite(there[i]) else 1.0
                if w < 1.0:
                    own, own_std = (u[i], std[i]) if finite[i] else (0.0, 0.0)
                    of = [0.0 if math.isnan(x) else x for x in (own_std, there_std[i])]
                    mixed = w * of[0] ** 2 + (1.0 - w) * of[1] ** 2 + w * (1.0 - w) * (own - there[i]) ** 2
                    u[i], std[i] = there[i] + w * (own - there[i]), math.sqrt(mixed) if w > 0.0 else there_std[i]
                    marks[i] = BLENDED if w > 0.0 else STAND_IN
            name += f"/{other['name']}" if any(marks) else ""
        marks = [mark | (0 if ok else NOT_FINITE) for mark, ok in zip(marks, finite, strict=True)]
    u, flags = _limited(u, inside, message["dt_s"], limits, u_before_V)
    flags = [mark | flag | (STALE if stale else 0) for mark, flag in zip(marks, flags, strict=True)]
    return {"u_V": u, "std_V": std, "flags": flags, "memory": after, "model": name}


def _limited(
    u: list[float], inside: list[bool], dt_s: float, limits: Limits, u_before_V: float
) -> tuple[list[float], list[int]]:
    low, high, slew = limits
    before = u_before_V
    safe, flags = [], []
    for value, within in zip(u, inside, strict=True):
        flag = 0 if within else OUTSIDE
        if not math.isfinite(value):
            value = before if math.isfinite(before) else 0.5 * (low + high)
            flag |= NOT_FINITE
        if not low <= value <= high:
            value = max(low, min(high, value))
            flag |= LIMITED_VOLTAGE
        if math.isfinite(before) and abs(value - before) > slew * dt_s:
            value = before + math.copysign(slew * dt_s, value - before)
            flag |= LIMITED_SLEW
        safe.append(value)
        flags.append(flag)
        before = value
    return safe, flags
