"""The changing state of an axis: each field is declared once, and all uses of the state follow from the declaration.

A field is declared in its annotation. Fields without an `Entry` are no part of the state::

    @dataclass(slots=True)
    class Rest:
        constant_V: Annotated[float, Entry("constant when the rest began, NaN in motion", "V", finite=False)] = nan
        steps: Annotated[int, Entry("updates since", low=0)] = 0

`save` writes a record as flat names to arrays and numbers, the form of checkpoints and of the wire. `load` checks every
entry before anything is built: compiled code reads arrays without checks of bounds, and a state may come from a
stranger. `restore` does the same for an object that is no dataclass, in place. `rows` lists the entries for people.

A class whose ``KIND`` is a text says so in an entry of that name, so that none is taken for another.

`Numbers` keep their numbers in a structured array, which compiled code reads and writes too.

What a field may be: a number, a truth value, a text; an array; a list, tuple or deque of numbers or of rows of numbers,
stored as an array; a dictionary of numbers or arrays by name; another record, or None.
"""

from __future__ import annotations

import types
from collections import deque
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, is_dataclass
from functools import cache
from math import inf, isfinite, isnan
from typing import (
    Annotated,
    Any,
    ClassVar,
    Final,
    NamedTuple,
    Protocol,
    TypeVar,
    Union,
    get_args,
    get_origin,
    get_type_hints,
    runtime_checkable,
)

import numpy as np

from dehyst.adaptive.errors import ModelFileError
from dehyst.adaptive.types import FloatArray, StateDict, parted

T = TypeVar("T")

#: Largest magnitude of a float: its cube is still finite. Largest magnitude of an integer: sample numbers of up to 2^62
#: are legal, and what is counted on from one must fit 64 bits.
MOST_FLOAT: Final = 1e100
MOST_INT: Final = 3 * 2**61
#: Longest dimension without a size of its own, and longest text.
MOST_ROWS: Final = 2_000_000
MOST_TEXT: Final = 100_000


@dataclass(frozen=True, slots=True)
class Entry:
    """Declaration of a field of the state.

    Attributes
    ----------
    meaning, unit : for people; unit "" : none.
    shape : of an array, ``"p,p|0"``: alternatives of dimensions, each a number or a name. A name that the caller of
        `load` gives no size for stands for one length within a record. "" : one dimension of any length.
    low, high : range of every element. finite : whether NaN and infinities are refused, and numbers beyond MOST_FLOAT.
    name : in the file, where it is not that of the field; "" puts the fields of a record among those of its owner.
    most : longest dimension, or longest text. among : the texts that are allowed, or the names of counts.
    """

    meaning: str
    unit: str = ""
    shape: str = ""
    low: float = -inf
    high: float = inf
    finite: bool = True
    name: str | None = None
    most: int = MOST_ROWS
    among: tuple[str, ...] = ()


class Kinded:
    """A class whose states say of which kind they are."""

    KIND: ClassVar[str]


class Numbers:
    """A record whose numbers are in ``record``, a structured array of shape () that compiled code works on too.

    Declared and made as a dataclass is: ``Rest(constant_V=0.0)`` has an array of its own, ``Rest(record=...)`` is a
    view of another's. What may be None has a truth value there. A class with an ``__init__`` of its own is a part.
    """

    record: Any
    _defaults: ClassVar[dict[str, Any]]

    def __init_subclass__(cls) -> None:
        cls._defaults = {}
        own: Any = cls
        for slot in _slots(own):
            name = slot.field.lstrip("_")
            if slot.optional:
                setattr(cls, slot.field, _at_times(name))
            elif slot.kind == "number":
                if slot.field in vars(cls):
                    cls._defaults[slot.field] = vars(cls)[slot.field]
                setattr(cls, slot.field, _number_in_record(name))
            elif slot.kind == "record" and issubclass(slot.of, Numbers):
                setattr(cls, slot.field, _record_in_record(name, slot.of))

    def __init__(self, *values: Any, record: Any = None, **named: Any) -> None:
        self.record = record
        if record is None:
            self.record = np.zeros((), record_of(_type(self)))
            fields = [slot.field for slot in _slots(_type(self))]
            given = self._defaults | dict(zip(fields, values, strict=False)) | named
            if given.keys() != set(fields):
                raise TypeError(f"{type(self).__name__}: got {', '.join(given)}, expected {', '.join(fields)}")
            for field, value in given.items():
                setattr(self, field, value)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Numbers) and bool(self.record == other.record)


def _number_in_record(name: str) -> property:
    def read(self: Numbers) -> Any:
        return self.record[name].item()

    def write(self: Numbers, value: Any) -> None:
        self.record[name] = value

    return property(read, write)


def _record_in_record(name: str, of: Any) -> property:
    def read(self: Numbers) -> Any:
        kept = vars(self).get(name)
        if kept is None:
            kept = vars(self)[name] = of(record=self.record[name])
        return kept

    def write(self: Numbers, value: Numbers) -> None:
        self.record[name] = value.record

    return property(read, write)


def _at_times(name: str) -> property:
    def read(self: Numbers) -> Any:
        return vars(self)[name] if self.record[name] else None

    def write(self: Numbers, value: Any) -> None:
        vars(self)[name], self.record[name] = value, value is not None

    return property(read, write)


@cache
def record_of(cls: Any) -> Any:
    """The structured type that holds the numbers of a class and of its parts by their names; None without any."""
    fields: list[tuple[str, Any]] = []
    for slot in _slots(cls):
        if issubclass(cls, Numbers) and (slot.optional or slot.kind == "number"):
            fields.append((slot.field.lstrip("_"), bool if slot.optional else slot.of))
        elif slot.kind in ("record", "part") and not slot.optional and record_of(slot.of) is not None:
            fields.append((slot.field.lstrip("_"), record_of(slot.of)))
    return np.dtype(fields, align=True) if fields else None


@runtime_checkable
class Checked(Protocol):
    """A record that checks what its fields must have in common; a part that is filled in place gets its new values."""

    def check_state(self, *values: Any) -> None:
        """Raise ValueError, ``NAME: got ..., expected ...``, where it does not fit."""
        ...


class Refused(ModelFileError):
    """An entry of a state is not as declared."""

    def __init__(self, name: str, got: str, expected: str = "") -> None:
        self.entry, self.got, self.expected = name, got, expected
        super().__init__(
            f"state entry {name}: {f'got {got}, expected {expected}' if expected else got}; the state is damaged, of "
            "another axis or of another version: start from the model file"
        )

    def under(self, prefix: str) -> Refused:
        """The same of a state that is part of another."""
        return Refused(prefix + self.entry, self.got, self.expected)

    @classmethod
    def by_check(cls, error: ValueError) -> Refused:
        """Of a check of what must fit together; it says "NAME: got ..., expected ..."."""
        name, _, what = str(error).partition(": ")
        return cls(name, what)


@contextmanager
def within(prefix: str) -> Iterator[None]:
    """Refusals from inside are of entries under ``prefix``."""
    try:
        yield
    except Refused as error:
        raise error.under(prefix) from error


@contextmanager
def part_of(state: StateDict, prefix: str) -> Iterator[StateDict]:
    """The entries under ``prefix``, taken out of ``state``; refusals from inside are of entries under it."""
    with within(prefix):
        yield {name.removeprefix(prefix): state.pop(name) for name in list(state) if name.startswith(prefix)}


# --- The declarations of a class.

_NUMBERS: Final = {float: "a finite number", int: "an integer", bool: "a truth value", str: "a text"}


class _Slot(NamedTuple):
    """A declared field. kind : "number", "array", "values" (numbers stored as an array), "named", "record", or "part"
    (an object that is filled in place). of : the type of its elements. make : of the container."""

    field: str
    name: str
    entry: Entry
    kind: str
    of: Any
    optional: bool
    make: Any
    shapes: tuple[tuple[int | str, ...], ...]


def _type(record: Any) -> Any:
    return type(record)


@cache
def _slots(cls: Any) -> tuple[_Slot, ...]:
    hints = get_type_hints(cls, include_extras=True).items()
    declared = ((field, *get_args(hint)[:2]) for field, hint in hints if get_origin(hint) is Annotated)
    return tuple(_slot(field, hint, entry) for field, hint, entry in declared if isinstance(entry, Entry))


def _slot(field: str, hint: Any, entry: Entry) -> _Slot:
    optional = get_origin(hint) in (Union, types.UnionType)
    if optional:
        hint = next(option for option in get_args(hint) if option is not type(None))
    make, of = get_origin(hint), get_args(hint)
    one = "*" if not entry.shape else entry.shape
    shapes = tuple(tuple(int(x) if x.isdigit() else x for x in shape.split(",")) for shape in one.split("|"))
    if hint in _NUMBERS:
        kind, made = "number", hint
    elif make is np.ndarray:
        kind, made = "array", np.dtype(get_args(of[1])[0])
    elif make is dict:
        kind, made = "named", of[1] if of[1] in _NUMBERS else np.dtype(get_args(get_args(of[1])[1])[0])
    elif make in (list, tuple, deque):
        kind, made = "values", of[0] if of[0] in _NUMBERS else get_args(of[0])[0]
    else:
        whole = is_dataclass(hint) or issubclass(hint, tuple)
        whole = whole or (issubclass(hint, Numbers) and hint.__init__ is Numbers.__init__)
        kind, made = "record" if whole else "part", hint
    name = field.lstrip("_") if entry.name is None else entry.name
    return _Slot(field, name, entry, kind, made, optional, make, shapes)


# --- Saving.


def save(record: Any, copies: bool = True) -> StateDict:
    """The declared fields of ``record`` under flat names; ``copies=False``: with the arrays themselves."""
    state: StateDict = {}
    _save(record, "", state, copies)
    return state


def _save(record: Any, prefix: str, state: StateDict, copies: bool) -> None:
    if isinstance(record, Kinded):
        state[f"{prefix}kind"] = record.KIND
    for slot in _slots(_type(record)):
        value, name, kind = getattr(record, slot.field), prefix + slot.name, slot.kind
        if kind == "number":
            state[name] = slot.of(value)
        elif kind == "array":
            if value is not None:
                state[name] = value.copy() if copies else value
        elif kind == "values":
            made, row = np.array(value, dtype=slot.of), slot.shapes[0]
            # Without a row, the array has the length of one all the same.
            state[name] = made.reshape(-1, row[1]) if len(row) == 2 and isinstance(row[1], int) else made
        elif kind == "named":
            below = f"{name}." if slot.name else prefix
            of = slot.of if slot.of in _NUMBERS else np.array
            state.update((below + key, of(one)) for key, one in value.items())
        elif value is not None:
            _save(value, f"{name}." if slot.name else prefix, state, copies)


# --- Loading.

Sizes = Mapping[str, float]
Given = Mapping[str, Any]
_NONE: Final[Sizes] = {}


def load(cls: type[T], state: Mapping[str, Any], sizes: Sizes | None = None, given: Given | None = None) -> T:
    """A record from its ``save``. Raises ModelFileError with the entry, what it is and what is expected.

    ``sizes`` : of named dimensions, and by unit the largest magnitude of an entry. ``given`` : undeclared fields by
    name; those of a nested record by its field.
    """
    return _build(cls, _values_of_all(cls, state, sizes or {}, given or {}), given or {})


def restore(part: Any, state: Mapping[str, Any], sizes: Sizes | None = None, given: Given | None = None) -> None:
    """Set the declared fields of ``part`` from its ``save``. Raises as ``load``; then nothing is changed."""
    values = _values_of_all(type(part), state, sizes or {}, given or {})
    _check(part, values)
    _put(part, values)


def _check(part: Any, values: dict[str, Any]) -> None:
    """Let a part that has ``check_state`` compare its new values with what it was made with."""
    if isinstance(part, Checked):
        try:
            part.check_state(values)
        except ValueError as error:
            raise Refused.by_check(error) from error
    for slot in _slots(_type(part)):
        if slot.kind == "part":
            with within(f"{slot.name}." if slot.name else ""):
                _check(getattr(part, slot.field), values[slot.field])


def _put(part: Any, values: dict[str, Any]) -> None:
    for slot in _slots(_type(part)):
        value = values[slot.field]
        if slot.kind == "part":
            _put(getattr(part, slot.field), value)
        elif isinstance(part, Numbers) and slot.kind == "array":
            getattr(part, slot.field)[...] = value
        else:
            setattr(part, slot.field, deque(value, getattr(part, slot.field).maxlen) if slot.make is deque else value)


def _build(cls: type[T], values: dict[str, Any], given: Given) -> T:
    own = {name: value for name, value in given.items() if name not in values}
    try:
        made = cls(**values, **own)
        if isinstance(made, Checked):
            made.check_state()
    except ValueError as error:
        raise Refused.by_check(error) from error
    return made


def _values_of_all(cls: Any, state: Mapping[str, Any], sizes: Sizes, given: Given) -> dict[str, Any]:
    """Field to value, with no entry left over."""
    parts = parted(state)
    values = _values(cls, parts, sizes, given, {})
    _no_more(parts)
    return values


def _no_more(parts: Mapping[str, StateDict]) -> None:
    for part, entries in parts.items():
        rest = next(iter(entries), "")
        raise Refused(f"{part}.{rest}" if rest else part, _words(entries.get(rest)), "no entry of this name")


def _values(cls: Any, parts: dict[str, StateDict], sizes: Sizes, given: Given, bound: dict[str, int]) -> dict[str, Any]:
    values: dict[str, Any] = {}
    if issubclass(cls, Kinded):
        _number(str, _leaf(parts, "kind"), Entry("", among=(cls.KIND,)), "kind")
    for slot in _slots(cls):
        name, of, below = slot.name, slot.of, given.get(slot.field, {})
        if slot.kind == "number":
            values[slot.field] = _number(of, _leaf(parts, name), slot.entry, name, sizes)
        elif slot.kind == "array" and slot.optional and name not in parts:
            values[slot.field] = None
        elif slot.kind in ("array", "values"):
            values[slot.field] = _sequence(slot, _leaf(parts, name), sizes, bound)
        elif slot.kind == "named":
            given_names = slot.entry.among or tuple(key for key in parts.get(name, ()) if key)
            below_parts = parts if not name else {key: {"": value} for key, value in parts.pop(name, {}).items()}
            with within(f"{name}." if name else ""):
                values[slot.field] = {key: _one(slot, _leaf(below_parts, key), key) for key in given_names}
                _no_more({} if not name else below_parts)
        elif not name:
            inner = _values(of, parts, sizes, below, bound)
            values[slot.field] = inner if slot.kind == "part" else _build(of, inner, below)
        elif slot.optional and name not in parts:
            values[slot.field] = None
        else:
            values[slot.field] = _nested(slot, name, parts, sizes, below)
    return values


def _nested(slot: _Slot, name: str, parts: dict[str, StateDict], sizes: Sizes, given: Given) -> Any:
    with within(f"{name}."):
        values = _values_of_all(slot.of, parts.pop(name, {}), sizes, given)
        return values if slot.kind == "part" else _build(slot.of, values, given)


def _leaf(parts: dict[str, StateDict], name: str) -> Any:
    entries = parts.pop(name, None)
    if entries is None or "" not in entries or len(entries) > 1:
        raise Refused(name, "nothing" if entries is None else f"entries {', '.join(list(entries)[:3])}", "one entry")
    return entries[""]


def _one(slot: _Slot, value: Any, name: str) -> Any:
    """A number or array of a dictionary."""
    if slot.of in _NUMBERS:
        return _number(slot.of, value, slot.entry, name)
    return _sequence(slot._replace(kind="array", name=name), value, {}, {})


def _number(of: Any, value: Any, entry: Entry, name: str, sizes: Sizes = _NONE) -> Any:
    """``value`` as a number, truth value or text of the type ``of``."""
    bounded = entry.finite or entry.unit in sizes
    most = sizes.get(entry.unit, MOST_FLOAT)
    if of is type(value) is float and -most <= value <= most and entry.low <= value <= entry.high:
        return value  # most are
    # JSON has no NaN: a file stores it as an array of shape ().
    if isinstance(value, np.generic) or (isinstance(value, np.ndarray) and value.shape == () and value.dtype == float):
        value = value.item()
    if type(value) is not of and not (of is float and type(value) is int):
        raise Refused(name, _words(value), _NUMBERS[of])
    if of is str:
        if entry.among and value not in entry.among:
            raise Refused(name, repr(value)[:80], repr(entry.among[0]) if len(entry.among) == 1 else str(entry.among))
        if len(value) > min(entry.most, MOST_TEXT):
            raise Refused(name, f"{len(value)} characters", f"at most {min(entry.most, MOST_TEXT)}")
        return value
    if of is bool:
        return value
    if type(value) is int and abs(value) > MOST_INT:
        raise Refused(name, str(value)[:40], "an integer from -3 x 2^61 to 3 x 2^61")
    if isfinite(value):
        small = of is int or not bounded or abs(value) <= most
        if not (entry.low <= value <= entry.high and small):
            raise Refused(name, repr(value), f"a number {_range(entry, most)}")
    elif entry.finite or (bounded and not isnan(value)):
        raise Refused(name, repr(value), _NUMBERS[of])
    return of(value)


def _sequence(slot: _Slot, value: Any, sizes: Sizes, bound: dict[str, int]) -> Any:
    """``value`` as the array or numbers that ``slot`` declares."""
    entry, name, dtype = slot.entry, slot.name, np.dtype(slot.of)
    if not isinstance(value, np.ndarray) or value.dtype != dtype or not _fits(slot, value.shape, sizes, bound):
        raise Refused(name, _words(value), f"an array of {dtype}, a shape of {_shapes(slot, sizes, bound)}")
    if value.size and dtype.kind != "b":
        most = _most(entry, value.shape, sizes) if dtype.kind == "f" else np.array(MOST_INT)
        # NaN is in no range.
        fits = (np.maximum(entry.low, -most) <= value) & (value <= np.minimum(entry.high, most))
        if not entry.finite and dtype.kind == "f":
            fits |= np.isnan(value) | (np.isinf(value) & (most == MOST_FLOAT))
        if not fits.all():
            wrong = value[~fits]
            expected = f"finite numbers {_range(entry, float(most.min()))}"
            raise Refused(name, f"elements from {wrong.min():g} to {wrong.max():g}", expected)
    if slot.kind == "array":
        return np.array(value, order="C")
    return slot.make(value.tolist() if value.ndim == 1 else map(tuple, value.tolist()))


def _most(entry: Entry, shape: tuple[int, ...], sizes: Sizes) -> FloatArray:
    """Largest magnitude of each element, to be broadcast: an entry may have a unit for each row, or each column."""
    units = entry.unit.split(", ")
    if not any(unit in sizes for unit in units):
        return np.array(MOST_FLOAT)
    most = np.array([sizes.get(unit, MOST_FLOAT) for unit in units])
    if most.size == 1:
        return most
    return most[:, np.newaxis] if shape[0] == most.size and len(shape) > 1 else most.repeat(shape[-1] // most.size)


def _fits(slot: _Slot, got: tuple[int, ...], sizes: Sizes, bound: dict[str, int]) -> bool:
    for shape in slot.shapes:
        if len(shape) != len(got):
            continue
        for x, n in zip(shape, got, strict=True):
            size = x if isinstance(x, int) else sizes.get(x, bound.get(x))
            if n != size and (size is not None or n > slot.entry.most):
                break
        else:
            bound.update((x, n) for x, n in zip(shape, got, strict=True) if isinstance(x, str) and x != "*")
            return True
    return False


def _shapes(slot: _Slot, sizes: Sizes, bound: dict[str, int]) -> str:
    named = [[sizes.get(str(x), bound.get(str(x), "n" if x == "*" else x)) for x in shape] for shape in slot.shapes]
    return " or ".join("(" + ", ".join(map(str, shape)) + ("," if len(shape) == 1 else "") + ")" for shape in named)


def _range(entry: Entry, most: float = inf) -> str:
    """The range in words; ``most`` : largest magnitude where the entry declares no range of its own."""
    if entry.low > -inf:
        return f"from {entry.low:g}" + (f" to {min(entry.high, most):g}" if min(entry.high, most) < inf else "")
    if entry.high < inf:
        return f"up to {min(entry.high, most):g}"
    return f"of at most {most:g}" if most < inf else ""


def _words(value: Any) -> str:
    return f"{value.dtype} {value.shape}" if isinstance(value, np.ndarray) else repr(value)[:80]


# --- The page.


class Row(NamedTuple):
    """An entry for people: its meaning with shape, unit and range."""

    name: str
    meaning: str


def rows(cls: Any, prefix: str = "", listed: dict[Any, str] | None = None) -> Iterator[Row]:
    """The entries that ``save`` writes of a record of ``cls``, in its order.

    ``listed`` : where the entries of a record are, "" for elsewhere. They are not listed again; new ones are added.
    None: all are listed.
    """
    for slot in _slots(cls):
        entry, name, one = slot.entry, prefix + slot.name, slot.of in _NUMBERS and slot.kind in ("number", "named")
        if slot.kind in ("record", "part"):
            inner = f"{name}." if slot.name else prefix
            first = listed.setdefault(slot.of, inner) if slot.name and listed is not None else inner
            if slot.name:
                told = (entry.meaning, "may be absent" * slot.optional, f"entries as in {first}" * (first != inner))
                yield Row(inner, ", ".join(filter(None, told)))
            if first == inner:
                yield from rows(slot.of, inner, listed)
            continue
        if slot.kind == "named":
            name = f"{name}.NAME" if slot.name else prefix + ", ".join(entry.among or ("NAME",))
        values = [_range(entry), "" if entry.finite else "or not finite"]
        if slot.of is bool or slot.of == np.dtype(bool):
            values = ["a truth value"]
        elif slot.of is str:
            values = [", ".join(filter(None, entry.among)) or "a text"]
        shape = "" if one else f"({' or '.join(','.join(map(str, shape)) for shape in slot.shapes)})"
        about = ", ".join(filter(None, (shape, entry.unit, *values)))
        yield Row(name, f"{entry.meaning} [{about}]" if about else entry.meaning)
