"""The C of a model: its tables before the templates of this folder, with the largest error of a voltage.

**Single precision.** Only the kernel part is computed in it; e = 2^-24. With d = x - s in units of the widths, t = d'd
and K = exp(-t), a term alpha K of D inputs is wrong by at most ::

    e |alpha| K (2 sum_j |d_j| (|x_j| + |s_j| + |d_j|) + (D + 1) t + 16 + N/32)

from rounding x, s and d; from their sum; from alpha, the exponential and the product; and from one of 32 partial sums
of N terms. |x_j| is at most |s_j| + |d_j|, K |d_j| at most 0.43, and K d_j² and K t at most 0.37. So this is at most
e |alpha| (1.72 sum_j |s_j| + 1.85 D + 0.37 + 16 + N/32). The same with e = 2^-53, for C and Python each, bounds what
may differ in double.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable
from dataclasses import dataclass
from importlib.resources import files
from typing import Any, Final, NamedTuple
from uuid import NAMESPACE_OID, uuid5

import numpy as np

from dehyst.adaptive.errors import InputError
from dehyst.adaptive.inverse_model import LssvmInverse
from dehyst.adaptive.types import FloatArray, InverseModel
from dehyst.baselines.bouc_wen.model import BoucWenInverse
from dehyst.baselines.common import Domain
from dehyst.baselines.linear import LinearInverse
from dehyst.baselines.prandtl_ishlinskii.model import MpiInverse, inverse_thresholds, inverse_weights
from dehyst.service.answers.guard import Limits
from dehyst.service.answers.which_model import domain_of

#: Support vectors that the C takes at a time; their number is filled up with weights of 0.
_LANES: Final = 32
#: Agreement with the model in Python that is claimed at best, V.
_SAME_V: Final = 1e-12
#: A name that is one in C and in an FMU.
_IDENTIFIER: Final = re.compile(r"[a-z][a-z0-9_]{0,40}\Z")
#: What is written from which template; an FMU needs the last two.
TEMPLATES: Final = {".h": "core.h", ".c": "core.c", "_test.c": "test.c", "_fmu.c": "fmu.c", ".xml": "fmu.xml"}


class CSource(NamedTuple):
    """The C of one model.

    Attributes
    ----------
    texts : of the files, by what follows NAME in their names; see `TEMPLATES`.
    error_V, error_single_V : largest error of a voltage in double and in single precision, V.
    """

    texts: dict[str, str]
    error_V: float
    error_single_V: float


@dataclass(frozen=True, slots=True)
class _Parts:
    """Template of a kind of model, its constants and tables, its domain (3, 2), and the error in units of e, V."""

    template: str
    values: dict[str, float]
    tables: dict[str, Any]
    domain: list[tuple[float, float]]
    error: float = 0.0


def domain(model: InverseModel) -> FloatArray:
    """(3, 2) bounds of y µm, v µm/s and a µm/s² inside which ``model`` says "inside". Raises as `c_source`."""
    return np.array(_parts(model).domain)


def c_source(model: InverseModel, limits: Limits, name: str, origin: str, start_um: float) -> CSource:
    """The C of ``model`` with ``limits``; its functions and files begin with ``name``.

    origin : what the model is, for the first comment. start_um : displacement at which an FMU begins by default, µm.

    Raises InputError where the name is none in C, or where the model is invalid or of a kind without a template.
    """
    if not _IDENTIFIER.match(name):
        raise InputError(f"--name: got {name!r}, expected 1 to 41 of a-z, 0-9 and _, beginning with a letter")
    parts = _parts(model)
    written = ["#ifdef EXPORT_SINGLE", *_limits(_inwards(limits.u_min_V, 1.0), _inwards(limits.u_max_V, -1.0))]
    written += ["#else", *_limits(limits.u_min_V, limits.u_max_V), "#endif"]
    values = parts.values | {
        "STEP_V": limits.slew_V_per_s * model.dt_s, "Y_MIN_UM": limits.y_min_um, "Y_MAX_UM": limits.y_max_um,
    }  # fmt: skip
    written += [f"#define {key} {_number(value)}" for key, value in values.items()]
    for key, table in (parts.tables | {"domain": np.ravel(parts.domain)}).items():
        kind = "int" if table.dtype.kind == "i" else "export_real" if key in ("alpha", "support") else "double"
        written += [f"static const {kind} {key}[{max(table.size, 1)}] = {{", *_rows(table.tolist() or [0]), "};"]
    tables = "\n".join(written)
    error_V = max(_SAME_V, 2.0 * parts.error * 2.0**-53)
    single_V = 1.01 * 2.0**-24 * (parts.error + 3.0 * max(abs(limits.u_min_V), abs(limits.u_max_V)))
    words = {
        "ORIGIN": origin, "TABLES": tables, "MODEL": _template(parts.template),
        "GUID": str(uuid5(NAMESPACE_OID, tables)), "MEMORY_SIZE": str(max(model.memory_size, 1)),
        "SAMPLE_TIME_S": repr(float(model.dt_s)),
        "ERROR_SINGLE": f"{single_V:.3e}", "ERROR_DOUBLE": f"{error_V:.3e}", "Y_START_UM": repr(float(start_um)),
    }  # fmt: skip
    texts = {}
    for ending, template in TEMPLATES.items():
        text = re.sub(rf"\b({'|'.join(words)})\b", lambda found: words[found[0]], _template(template))
        texts[ending] = re.sub(r"\bEXPORT(?=_)", name.upper(), re.sub(r"\bexport(?=[_.\"])", name, text))
    return CSource(texts, error_V, single_V)


def _template(file: str) -> str:
    return (files("dehyst.service.export") / file).read_text(encoding="utf-8")


def _parts(model: InverseModel) -> _Parts:
    if isinstance(model, LssvmInverse):
        return _lssvm(model)
    if isinstance(model, LinearInverse):
        line = model.parameters
        values = {"GAIN_UM_PER_V": line.gain_um_per_V, "OFFSET_UM": line.offset_um}
        return _Parts("linear.c", values, {}, _bounds(model.domain, math.inf))
    if isinstance(model, BoucWenInverse):
        names = ("V_PER_UM", "OFFSET_UM", "LAG_S", "INERTIA_S2", "ALPHA", "BETA", "GAMMA")
        values = dict(zip(names, model.constants[:7].tolist(), strict=True))
        return _Parts("bouc_wen.c", values, {}, _bounds(model.domain, model.domain.v_max_um_per_s))
    if isinstance(model, MpiInverse):
        m = model.parameters
        values = {"PLAYS": m.r_.size, "ZONES": m.d_.size, "C_UM": m.c_um, "Y_REF_UM": m.y_ref_um, "LAG_S": m.lag_s}
        tables = {
            "play_um": inverse_thresholds(m.w_h_, m.r_), "play_V_per_um": inverse_weights(m.w_h_),
            "zone_um": inverse_thresholds(m.w_s_, m.d_), "zone_weight": inverse_weights(m.w_s_),
        }  # fmt: skip
        return _Parts("mpi.c", values, tables, _bounds(model.domain, model.domain.v_max_um_per_s))
    raise InputError(
        f"model {model.name!r}: got a {type(model).__name__}, expected a kind that can be exported: an LSSVM, a line, "
        "Bouc-Wen or Prandtl-Ishlinskii"
    )


def _lssvm(model: LssvmInverse) -> _Parts:
    if not model.valid:
        raise InputError(f"model {model.name!r}: its learner declares it invalid, expected a valid one; name another")
    m, (n, inputs), bounds = model.features.arrays, model.support.shape, domain_of(model)
    scaled, fill = model.support / model.widths, -n % _LANES
    values: dict[str, float] = {
        "PLAYS": m.thresholds.size, "ARCS": m.arcs.size, "SLOW": m.retain.size, "BASIS": model.beta.size,
        "INPUTS": inputs, "SUPPORT": n + fill, "LINEAR": int(m.flags[0]), "ASYMMETRIC": int(m.flags[1]),
        "ANCHORED": int(model.anchor.size > 0), "ALLOWED_V": model.allowed_V, "OFFSET_UM": m.frame[0],
        "PER_GAIN": m.frame[1], "DEAD_UM": m.frame[2], "CENTRE_UM": m.scale[0], "PER_UM": m.scale[1],
        "PER_UM_PER_S": m.scale[2], "PER_UM_PER_S2": m.scale[3], "Y_REST_UM": model.features.y_rest_um,
    }  # fmt: skip
    tables = {
        "threshold_um": m.thresholds, "arc_um": m.arcs, "retain": m.retain, "kernel_play": m.kernel_plays,
        "beta": model.beta, "anchor": model.anchor if model.anchor.size else np.zeros_like(model.beta),
        "per_width": 1.0 / model.widths, "alpha": np.pad(model.alpha, (0, fill)),
        "support": np.pad(scaled, ((0, fill), (0, 0))).T.ravel(),
    }  # fmt: skip
    each = 1.72 * np.abs(scaled).sum(axis=1) + 1.85 * inputs + 0.37 + 16.0 + n / _LANES
    return _Parts("lssvm.c", values, tables, bounds or [], float(np.abs(model.alpha) @ each))


def _bounds(domain: Domain, v_max_um_per_s: float) -> list[tuple[float, float]]:
    return [(domain.y_min_um, domain.y_max_um), (-v_max_um_per_s, v_max_um_per_s), (-math.inf, math.inf)]


def _inwards(limit_V: float, towards: float) -> float:
    """``limit_V`` in single precision, rounded up (``towards`` 1) or down (-1): no voltage is rounded beyond it."""
    near = np.float32(limit_V)
    return float(near if (float(near) - limit_V) * towards >= 0.0 else np.nextafter(near, np.float32(towards * np.inf)))


def _limits(u_min_V: float, u_max_V: float) -> list[str]:
    return [f"#define U_MIN_V {_number(u_min_V)}", f"#define U_MAX_V {_number(u_max_V)}"]


def _number(value: float) -> str:
    """A number in C, exact to the last bit."""
    text = "INFINITY" if abs(value) == math.inf else repr(abs(value) if isinstance(value, int) else abs(float(value)))
    return f"(-{text})" if value < 0.0 else text


def _rows(numbers: Iterable[float]) -> list[str]:
    """Rows of a table, at most 120 characters each."""
    rows = ["   "]
    for text in map(_number, numbers):
        if len(rows[-1]) + len(text) > 118:
            rows.append("   ")
        rows[-1] += f" {text},"
    return rows
