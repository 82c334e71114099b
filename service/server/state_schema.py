"""What the entries of an axis' state must be: type, shape, finiteness and range, checked before anything is built.

Compiled code reads arrays without checks of bounds, so that an array of another shape ends the process. A state may
come from a file or from another process. `StateSchema.check` compares every entry with the configuration: with a
learner of that configuration that has learnt some samples (the *template*), and with `RULES` for entries that only
some states have, or whose length varies.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from adaptive.errors import ModelFileError
from adaptive.online.sensor_trust import VALUES
from adaptive.types import StateDict
from adaptive.window import arrays as window_arrays

#: Largest magnitude of a float: its cube is still finite. Largest magnitude of an integer: sample numbers of up to 2^62
#: are legal, and what is counted on from one must fit 64 bits.
MOST_FLOAT: Final = 1e100
MOST_INT: Final = 3 * 2**61
#: Longest variable dimension, longest text, and most entries.
MOST_ROWS: Final = 2_000_000
MOST_TEXT: Final = 100_000
MOST_ENTRIES: Final = 100_000


@dataclass(frozen=True, slots=True)
class Rule:
    """The rule for the entries whose names match ``pattern``, from the beginning of one of their parts to the end.

    Attributes
    ----------
    shapes : allowed ones, separated by "|". Dimensions are numbers or names: p inputs of the linear part, d of the
        kernel, m entries of the hysteresis memory, N samples of the window; * any. "" : a scalar.
    kind : "f" floats, "i" integers, "b" truth values, "s" text.
    low, high : range of every element; names of dimensions are allowed.
    finite : whether NaN and infinities are refused.
    """

    pattern: str
    shapes: str
    kind: str = "f"
    low: float | str = -np.inf
    high: float | str = np.inf
    finite: bool = True


RULES: Final = (
    # --- the axis
    Rule(r"sequence\.gaps", "*,2", "i"),
    Rule(r"sequence\.(t_s|run_t_s)", "", finite=False),
    Rule(r"sequence\.(received|lost|late|restarts|since|run)", "", "i", low=0),
    Rule(r"clock\.t_\w+_s", "", finite=False),
    Rule(r"tracker\.rows", "*,4"),
    Rule(r"tracker\.(y|v)", "", finite=False),
    Rule(r"served\.u_V", "", finite=False),
    Rule(r"served\.trust", "", low=0.0, high=1.0),
    Rule(r"^gates\.\w+", "", "i", low=0),
    Rule(r"^memory\.\w+", "*"),
    Rule(r"^frozen\.held", "*"),
    Rule(r"watch\.(y|u_low|u_high)", "", finite=False),
    Rule(r"watch\.trust", "", low=0.0, high=1.0),
    Rule(r"^(frozen_by|adoptions|watch\.trouble|served\.(default|trouble))", "", "s"),
    # --- models
    Rule(r"(features|before|proven)\.thresholds_um", "plays"),
    Rule(r"(features|before|proven)\.arc_lengths_um", "arcs"),
    Rule(r"(features|before|proven)\.time_constants_s", "slow"),
    Rule(r"(features|before|proven)\.kernel_plays", "kernel_plays", "i", low=0, high="plays"),
    Rule(r"(features|before|proven)\.(linear|asymmetric)", "", "b"),
    Rule(r"(lssvm_adaptive|model|good|mark|next_mark|base|learn)\.beta", "p"),
    Rule(r"support", "*,d"),
    Rule(r"alpha", "*"),
    Rule(r"anchor", "p|0"),
    Rule(r"beta_covariance", "p,p|0,0"),
    Rule(r"(domain)", "6"),
    Rule(r"(?<!window\.)widths", "d"),
    Rule(r"voltage_std_V", "", finite=False),
    # --- the learner
    Rule(r"front\.(past\d|proven_past)\.(motion)", "3"),
    Rule(r"front\.(past\d|proven_past)\.u_before_V", "", finite=False),
    Rule(r"front\.(past\d|proven_past)\.(lag_V|lag_um|u_V)", "*", finite=False),
    Rule(r"front\.(past\d|proven_past)\.memory", "m"),
    Rule(r"front\.heard", "*,2"),
    Rule(r"front\.hold\.(u_V|y_um|old_um)", "*", finite=False),
    Rule(r"front\.hold\.\w*_um", "", finite=False),
    Rule(r"front\.(trial|control)\.window", "4,values", finite=False),
    Rule(r"front\.(trial|control)\.memory", "m"),
    Rule(r"front\.(trial|control)\.(fault|why|suspected)", "", "s"),
    Rule(r"front\.missing\.members", "*,m"),
    Rule(r"front\.missing\.(noise_V|std_V|moved_s)", "", low=0.0),
    Rule(r"front\.missing\.since", "", "i", low=0),
    Rule(r"front\.missing\.rests", "", "b"),
    Rule(r"reckoning\.memory", "m"),
    Rule(r"reckoning\.numbers", "11"),
    Rule(r"following\.(u_V|p_V|last_V)", "", finite=False),
    Rule(r"front\.track\.motion", "3|0"),
    Rule(r"front\.track\.(y_um|u_V)", "slots", finite=False),
    Rule(r"front\.track\.good", "slots", "b"),
    Rule(r"front\.track\.(memory|frozen_memory)", "m"),
    Rule(r"front\.track\.switch", "", "i", low=0),
    Rule(r"smoother\.count", "", "i", low=0),
    Rule(r"rest\.(constant_V|u_V)", "", finite=False),
    Rule(r"moved_V", "", low=0.0),
    Rule(r"moved_s", "", low=1e-9),
    Rule(r"delay", "*,p|0"),
    Rule(r"point", "d", finite=False),
    Rule(r"((next|jump|proven)_)?(mark|confirmed\d)\.covariance", "p,p"),
    Rule(r"((next|jump|proven)_)?(mark|confirmed\d)\.beta", "p"),
    Rule(r"window\.C", "counters", "i", low=-1),
    Rule(r"window\.order", "N", "i", low=0, high="N-1"),
    Rule(r"window\.born", "N", "i"),
    Rule(r"window\.(clock|changed)", "", "i", low=0),
    Rule(r"window\.next", "", "i", low=-1, high="N"),
    Rule(r"window\.(gamma|kernel_variance)", "", low=0.0),
    Rule(r"window\.(inverse_widths|widths)", "d", low=1e-100),
    Rule(r"window\.V", "vectors,N"),
    Rule(r"window\.(P|R)", "N,N"),
    Rule(r"window\.PR", "N,*"),
    Rule(r"window\.healing\.(X|scaled)", "d,N"),
    Rule(r"window\.healing\.(R|P)", "N,N"),
    Rule(r"window\.healing\.(y|w)", "N"),
    Rule(r"window\.healing\.count", "", "i", low=1, high="N"),
    Rule(r"window\.healing\.(form|new_form)", "", "i", low=0, high=1),
    Rule(r"window\.healing\.left", "", "i", low=-1, high=1000),
    # --- the competition and what learns in it
    Rule(r"motion\.u", "*"),
    Rule(r"motion\.rows", "*,5"),
    Rule(r"motion\.(glitches|since_start|since_left)", "", "i", low=0),
    Rule(r"^learner\.past_seq", "*", "i"),
    Rule(r"^learner\.champion", "", "i", low=0, high="contestants-1"),
    Rule(r"score\.\w+\.memory", "*"),
    Rule(r"recent", "*,2"),
    Rule(r"pending", "*"),
    Rule(r"taught_u_V", "", finite=False),
)
#: Entries whose text must be that of the template: they say which contestants and kinds of models there are.
_SAME_TEXT: Final = re.compile(r"(^|\.)(names|kinds)$")
#: Snapshots of a competition at earlier times have the entries of the newest one; a kept state those of the learner.
_SNAPSHOTS: Final = re.compile(r"^(learner\.(past\d+|start)|frozen\.auto)\.")
_KEPT: Final = re.compile(r"^mark\.")
#: Settings and what is identified: compared with those of the present learner where it is restored.
_COMPARED: Final = re.compile(r"(^|\.)config[._]")


class StateSchema:
    """The schema of the states of one axis.

    Parameters
    ----------
    template : state of a learner of the axis' configuration that has learnt some samples; empty for none.
    memories : size of the hysteresis memory of each model that is served, by name.
    """

    def __init__(self, template: StateDict, memories: Mapping[str, int]) -> None:
        self._memories = dict(memories)
        self._template = {f"learner.{name}": _form_of(value) for name, value in template.items()}
        self._texts = {f"learner.{name}": value for name, value in template.items() if isinstance(value, str)}
        self._sizes = _sizes_of(template)
        self._rules: dict[str, Rule | None] = {}

    def check(self, state: StateDict) -> None:
        """Raise ModelFileError with the entry, what it is and what is expected, unless ``state`` fits."""
        if len(state) > MOST_ENTRIES:
            raise ModelFileError(f"state: got {len(state)} entries, expected at most {MOST_ENTRIES}")
        for name, value in state.items():
            if not _COMPARED.search(name):
                self._check(name, value)
        self._check_together(state)

    # ---- inside

    def _check(self, name: str, value: Any) -> None:
        canonical = _SNAPSHOTS.sub("learner.newest.", _KEPT.sub("learner.", name))
        rule, form = self._rule(canonical), self._template.get(canonical)
        if _SAME_TEXT.search(canonical) and canonical in self._texts and not _is_text(value, self._texts[canonical]):
            raise _refused(name, repr(value)[:80], repr(self._texts[canonical]))
        if rule is not None and form is not None and form.array != bool(rule.shapes):
            rule = None  # another entry with the same ending
        if rule is not None:
            self._check_rule(name, canonical, value, rule)
        elif form is not None:
            _check_form(name, value, form)
        elif isinstance(value, np.ndarray):
            if value.ndim:
                raise _refused(name, _words(value), "no array of this name")
            raise _refused(name, _words(value), "a finite number")
        else:
            _check_scalar(name, value, None)

    def _rule(self, canonical: str) -> Rule | None:
        if canonical not in self._rules:
            matches = (rule for rule in RULES if re.search(rf"(^|\.)({rule.pattern})$", canonical))
            self._rules[canonical] = next(matches, None)
        return self._rules[canonical]

    def _check_rule(self, name: str, canonical: str, value: Any, rule: Rule) -> None:
        if not rule.shapes:
            _check_scalar(name, value, rule.kind, rule.finite)
            if rule.kind in "fi" and value is not None and not isinstance(value, np.ndarray):
                low, high = self._number(rule.low), self._number(rule.high)
                if not low <= value <= high and (rule.finite or math.isfinite(value)):
                    raise _refused(name, repr(value), f"a number from {low:g} to {high:g}")
            return
        template = self._template.get(canonical)
        shapes = [self._shape(text, template) for text in rule.shapes.split("|")]
        if not isinstance(value, np.ndarray) or value.dtype != _DTYPES[rule.kind]:
            raise _refused(name, _words(value), f"an array of {_DTYPES[rule.kind]} {_shapes(shapes)}")
        older = canonical.endswith((".window.V", ".window.C"))  # states of older versions lack the last rows
        if not any(_fits(value.shape, shape, older) for shape in shapes):
            raise _refused(name, _words(value), f"a shape of {_shapes(shapes)}")
        _check_elements(name, value, rule.finite, self._number(rule.low), self._number(rule.high))

    def _shape(self, text: str, template: _Form | None) -> tuple[int | None, ...]:
        if text == "one":
            return ()
        dimensions = []
        for i, part in enumerate(text.split(",")):
            if part == "*" or part.isdigit():
                dimensions.append(None if part == "*" else int(part))
            elif part in self._sizes:
                dimensions.append(self._sizes[part])
            else:  # no learner of that kind
                dimensions.append(template.shape[i] if template is not None and len(template.shape) > i else None)
        return tuple(dimensions)

    def _number(self, value: float | str) -> float:
        if isinstance(value, float | int):
            return value
        name, _, less = value.partition("-")
        return float(self._sizes.get(name, MOST_INT) - int(less or 0))

    def _check_together(self, state: StateDict) -> None:
        """What entries must have in common."""
        for name, value in state.items():
            if name.startswith("memory.") and name[7:] in self._memories:
                expected = self._memories[name[7:]]
                if value.shape != (expected,):
                    raise _refused(name, _words(value), f"a shape of ({expected},)")
            for ending, other, same in _PAIRS:
                if not name.endswith(ending):
                    continue
                partner = state.get(name[: -len(ending)] + other)
                if not isinstance(partner, np.ndarray) or not same(value, partner):
                    raise _refused(name, _words(value), f"to fit {other.strip('.')}, {_words(partner)}")
            if name.endswith("window.C"):
                self._check_counters(name, value)
            elif name.endswith("window.order") and not np.array_equal(np.sort(value), np.arange(value.size)):
                raise _refused(name, "no permutation", f"each of 0 to {value.size - 1} once")
            elif re.search(r"(^|\.)score\.\w+\.memory$", name):
                size = self._memories.get(name.split(".")[-2])
                if value.size and size is not None and value.size != size:
                    raise _refused(name, _words(value), f"a shape of ({size},) or (0,)")

    def _check_counters(self, name: str, C: NDArray[np.int64]) -> None:
        n = self._sizes.get("N", MOST_INT)
        places = (window_arrays.COUNT, window_arrays.UNDO_SLOT, window_arrays.CURSOR, window_arrays.UNDO_PLACE,
                  window_arrays.CARRIED)  # fmt: skip
        for place in places:
            if place < C.size and C[place] > n:
                raise _refused(f"{name}[{place}]", int(C[place]), f"at most the window's {n} samples")
        if C[window_arrays.COUNT] < 0 or not 0 <= C[window_arrays.FORM] <= 1 or C[window_arrays.CURSOR] < 0:
            raise _refused(name, C[: window_arrays.CURSOR + 1].tolist(), "a count, a form of 0 or 1 and a cursor")


def _is_text(value: Any, text: str) -> bool:
    return isinstance(value, str) and value == text


def _same_length(a: NDArray[Any], b: NDArray[Any]) -> bool:
    return len(a) == len(b)


#: (end of a name, end of its partner's, what must hold of the two).
_PAIRS: Final[tuple[tuple[str, str, Callable[[NDArray[Any], NDArray[Any]], bool]], ...]] = (
    (".lag_um", ".lag_V", lambda um, V: len(um) <= len(V)),
    (".hold.y_um", ".hold.u_V", _same_length),
    (".hold.old_um", ".hold.u_V", _same_length),
    # A row of least squares is the pending part and one or more entries besides.
    (".pending", ".normal", lambda pending, normal: pending.size < len(normal)),
)


# --- Forms.

_DTYPES: Final = {"f": np.dtype(np.float64), "i": np.dtype(np.int64), "b": np.dtype(np.bool_)}


@dataclass(frozen=True, slots=True)
class _Form:
    """Form of an entry of the template: kind, shape of an array (None: a scalar), whether it is finite."""

    kind: str
    shape: tuple[int, ...]
    array: bool
    finite: bool


def _form_of(value: Any) -> _Form:
    if isinstance(value, np.ndarray):
        finite = value.dtype.kind != "f" or bool(np.isfinite(value).all())
        return _Form(value.dtype.kind, value.shape, True, finite)
    kinds = ((bool, "b"), (int, "i"), (float, "f"), (str, "s"))
    scalar = value.item() if isinstance(value, np.generic) else value
    kind = next((kind for known, kind in kinds if isinstance(scalar, known)), "?")
    return _Form(kind, (), False, kind != "f" or bool(np.isfinite(scalar)))


def _sizes_of(template: StateDict) -> dict[str, int]:
    """Names of dimensions, from the identified model and the window of the learner in ``template``."""
    sizes = {"counters": window_arrays.COUNTERS, "vectors": window_arrays.ROWS, "values": VALUES}
    for name, value in template.items():
        head, _, tail = name.rpartition("base.support")
        if tail or not isinstance(value, np.ndarray) or not name.endswith("base.support"):
            continue
        base = {key[len(head) + 5 :]: entry for key, entry in template.items() if key.startswith(f"{head}base.")}
        parts = {"plays": "thresholds_um", "arcs": "arc_lengths_um", "slow": "time_constants_s"}
        sizes |= {size: len(base[f"features.{part}"]) for size, part in parts.items()}
        sizes["kernel_plays"] = len(base["features.kernel_plays"])
        sizes["p"], sizes["d"] = base["beta"].size, base["widths"].size
        sizes["m"] = sizes["plays"] + sizes["arcs"] + sizes["slow"] + (sizes["arcs"] > 0)
        sizes["N"] = template[f"{head}window.order"].size
    out = template.get("out")
    if isinstance(out, np.ndarray):
        sizes["contestants"] = out.size
    return sizes


def _check_form(name: str, value: Any, form: _Form) -> None:
    if not form.array:
        _check_scalar(name, value, form.kind, form.finite)
        return
    if not isinstance(value, np.ndarray) or value.dtype != _DTYPES[form.kind] or value.shape != form.shape:
        raise _refused(name, _words(value), f"an array of {_DTYPES[form.kind]} {form.shape}")
    _check_elements(name, value, form.finite, -np.inf, np.inf)


def _check_scalar(name: str, value: Any, kind: str | None, finite: bool = True) -> None:
    if isinstance(value, np.ndarray):  # JSON has no NaN: it is stored as an array of shape ()
        if kind == "f" and not finite and value.shape == () and value.dtype == _DTYPES["f"]:
            return
        raise _refused(name, _words(value), _KINDS.get(kind or "?", "a number, a truth value or a text"))
    value = value.item() if isinstance(value, np.generic) else value
    fits = {
        "f": value is None or (isinstance(value, float | int) and not isinstance(value, bool)),
        "i": isinstance(value, int) and not isinstance(value, bool),
        "b": isinstance(value, bool) or (isinstance(value, int) and value in (0, 1)),
        "s": isinstance(value, str),
    }.get(kind or "?", value is None or isinstance(value, float | int | str))
    if not fits:
        raise _refused(name, repr(value)[:80], _KINDS.get(kind or "?", "a number, a truth value or a text"))
    if isinstance(value, str) and len(value) > MOST_TEXT:
        raise _refused(name, f"{len(value)} characters", f"at most {MOST_TEXT}")
    if isinstance(value, int) and abs(value) > MOST_INT:
        raise _refused(name, str(value)[:40], "an integer from -3 x 2^61 to 3 x 2^61")
    if isinstance(value, float) and finite and not abs(value) <= MOST_FLOAT:
        raise _refused(name, repr(value), f"a finite number of at most {MOST_FLOAT:g}")


def _check_elements(name: str, value: NDArray[Any], finite: bool, low: float, high: float) -> None:
    if not value.size or value.dtype.kind == "b":
        return
    if value.dtype.kind == "f":
        known = value if finite else value[np.isfinite(value)]
        if not known.size:
            return
        least, most = float(known.min()), float(known.max())
        if not (least >= -MOST_FLOAT and most <= MOST_FLOAT):
            raise _refused(name, f"elements from {least:g} to {most:g}", f"finite numbers of at most {MOST_FLOAT:g}")
    else:
        least, most = int(value.min()), int(value.max())
        low, high = max(low, -MOST_INT), min(high, MOST_INT)
    if not (low <= least and most <= high):
        raise _refused(name, f"elements from {least} to {most}", f"from {low:g} to {high:g}")


_KINDS: Final = {"f": "a finite number", "i": "an integer", "b": "a truth value", "s": "a text"}


def _fits(got: tuple[int, ...], wanted: tuple[int | None, ...], older: bool) -> bool:
    if len(got) != len(wanted) or any(n > MOST_ROWS for n in got):
        return False
    first = older and wanted[0] is not None and 0 < got[0] <= wanted[0]
    return all(n == m or m is None or (first and i == 0) for i, (n, m) in enumerate(zip(got, wanted, strict=True)))


def _shapes(shapes: list[tuple[int | None, ...]]) -> str:
    return " or ".join("(" + ", ".join("n" if n is None else str(n) for n in shape) + ")" for shape in shapes)


def _words(value: Any) -> str:
    return f"{value.dtype} {value.shape}" if isinstance(value, np.ndarray) else repr(value)[:80]


def _refused(name: str, got: Any, expected: str) -> ModelFileError:
    return ModelFileError(
        f"state entry {name}: got {got}, expected {expected}; the state is damaged or of another axis"
    )
