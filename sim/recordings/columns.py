"""The meaning of a file's columns: names and units as the user states them, never guessed.

A unit comes from an option, from the file's own entry for the column (TDMS, HDF5), or from the end of the
column's name (``y_nm``). A column without any of them is refused with the option that adds it.
"""

from __future__ import annotations

import math
import re
import tomllib
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from dehyst.adaptive.errors import InputError

_VOLTAGE = {"V": 1.0, "mV": 1e-3, "uV": 1e-6, "kV": 1e3}
_LENGTH = {"um": 1.0, "µm": 1.0, "μm": 1.0, "nm": 1e-3, "pm": 1e-6, "mm": 1e3, "m": 1e6}
#: To µrad, which stand in the place of µm.
_ANGLE = {
    "urad": 1.0, "µrad": 1.0, "μrad": 1.0, "mrad": 1e3, "rad": 1e6,
    "arcsec": 1e6 * math.pi / 648_000, "arcmin": 1e6 * math.pi / 10_800, "deg": 1e6 * math.pi / 180,
}  # fmt: skip
_TIME = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6, "ns": 1e-9, "min": 60.0, "day": 86_400.0}
_RATE = {"Hz": 1.0, "hz": 1.0, "kHz": 1e3}
#: Kelvin also have an offset, which the reader subtracts.
_TEMPERATURE = {"C": 1.0, "degC": 1.0, "K": 1.0}
KELVIN_AT_0_C = 273.15

#: Names of units that acquisition programs write into their files, in lower case.
_UNIT_WORDS = {
    **dict.fromkeys(("volt", "volts", "vdc"), "V"),
    **dict.fromkeys(("millivolt", "millivolts", "mvdc"), "mV"),
    **dict.fromkeys(("micrometer", "micrometers", "micrometre", "micrometres", "micron", "microns"), "um"),
    **dict.fromkeys(("mikrometer", "mikron", "micromètre", "micromètres"), "um"),
    # UTF-8 that a program took for Latin-1.
    **dict.fromkeys(("âμm", "î¼m"), "um"),
    **dict.fromkeys(("nanometer", "nanometers", "nanometre", "nanometres"), "nm"),
    **dict.fromkeys(("millimeter", "millimeters", "millimetre", "millimetres"), "mm"),
    **dict.fromkeys(("meter", "meters", "metre", "metres"), "m"),
    **dict.fromkeys(("s", "sec", "secs", "second", "seconds", "sekunde", "sekunden", "secondes"), "s"),
    **dict.fromkeys(("millisecond", "milliseconds", "msec", "msecs", "millisekunden"), "ms"),
    **dict.fromkeys(("microsecond", "microseconds", "usec", "usecs", "μsec", "mikrosekunden", "âμs"), "us"),
    **dict.fromkeys(("nanosecond", "nanoseconds", "nsec", "nanosekunden"), "ns"),
    **dict.fromkeys(("°c", "deg c", "celsius"), "C"),
    **dict.fromkeys(("kelvin",), "K"),
    **dict.fromkeys(("hertz",), "Hz"),
    **dict.fromkeys(("day", "days"), "day"),
    **dict.fromkeys(("degree", "degrees", "°"), "deg"),
    # Units of other kinds, which need a factor.
    **{name: name for name in ("ohm", "counts")},
}

#: quantity -> (canonical column, factors to its unit by unit name)
QUANTITIES: dict[str, tuple[str, dict[str, float]]] = {
    "t": ("t_s", _TIME),
    "u": ("u_V", _VOLTAGE),
    "y": ("y_um", _LENGTH | _ANGLE),
    "u2": ("u2_V", _VOLTAGE),
    "y2": ("y2_um", _LENGTH | _ANGLE),
    "u3": ("u3_V", _VOLTAGE),
    "monitor": ("monitor_V", _VOLTAGE),
    "temperature": ("temperature_C", _TEMPERATURE),
    "dt": ("dt_s", _TIME),
    "rate": ("rate_Hz", _RATE),
}

#: Quantities with one value per sample.
SAMPLED = tuple(quantity for quantity in QUANTITIES if quantity not in ("dt", "rate"))


@dataclass(frozen=True, slots=True)
class ColumnMap:
    """How to read a file that does not have the canonical columns.

    Attributes
    ----------
    columns : quantity -> name of the column or array in the file (quantities: ``t u y u2 y2 u3 monitor temperature``,
        and the scalars ``dt`` and ``rate``); in text and workbooks also its position from 1 (``"2"``), or several
        neighbours as one array (``"2:6"``).
    units : quantity -> unit of that column (``V mV kV``; ``um nm pm mm m``; angles, which become µrad: ``urad
        mrad rad arcsec arcmin deg``; ``s ms us ns min day``; ``C K``; ``Hz kHz``).
    scale : quantity -> factor from the file's number to the canonical unit, in place of a unit, for a column in
        another quantity (10 for a sensor of 10 µm per volt).
    index : quantity -> part of an array of several dimensions, with one ``:`` for the samples (``":,0,2"``), and
        ``*`` for the dimension whose entries are put one after another (``"*,:"``: periods of samples).
    files : quantity -> file that holds it, where that is not the recording's main file.
    repeat : quantities whose samples are one period, repeated for as long as ``u`` or ``y``, the longer one, lasts.
    dt_s : sample time, s, where the file has no time column.
    sensor_late : samples by which the sensor's column is late in the file. The readings are moved back by as many
        samples, and as many samples at the end are dropped.
    delimiter, decimal : of a text file, where its first lines do not show them.
    header : number of the text line (or row of a workbook's sheet) that holds the columns' names, from 1, or ``none``
        where the columns have no names. Without it, the first line decides, if it can.

    Raises InputError on an unknown quantity or unit, and on values out of range.
    """

    columns: dict[str, str] = field(default_factory=dict)
    units: dict[str, str] = field(default_factory=dict)
    scale: dict[str, float] = field(default_factory=dict)
    index: dict[str, str] = field(default_factory=dict)
    files: dict[str, Path] = field(default_factory=dict)
    repeat: tuple[str, ...] = ()
    dt_s: float | None = None
    sensor_late: int = 0
    delimiter: str | None = None
    decimal: str | None = None
    header: str | None = None

    def __post_init__(self) -> None:
        for name in ("columns", "units", "scale", "index", "files"):
            for quantity in getattr(self, name):
                if quantity not in QUANTITIES:
                    raise InputError(f"{name}: got quantity {quantity!r}, expected one of {', '.join(QUANTITIES)}")
        self._check_layout()
        for quantity, unit in self.units.items():
            factors = QUANTITIES[quantity][1]
            if unit not in factors:
                raise InputError(f"unit of {quantity}: got {unit!r}, expected one of {', '.join(factors)}")
            if quantity in self.scale:
                raise InputError(f"{quantity}: got both a unit and a scale, expected one of the two")
        for quantity, factor in self.scale.items():
            if not (abs(factor) > 0.0 and abs(factor) < float("inf")):
                raise InputError(f"scale of {quantity}: got {factor!r}, expected a finite number other than 0")
        if self.dt_s is not None and not (0.0 < self.dt_s < 1e6):
            raise InputError(f"dt_s: got {self.dt_s!r}, expected a positive sample time in s")
        if self.sensor_late < 0:
            raise InputError(f"sensor_late: got {self.sensor_late}, expected a number of samples, 0 or more")
        if self.decimal not in (None, ".", ","):
            raise InputError(f"decimal: got {self.decimal!r}, expected '.' or ','")

    def _check_layout(self) -> None:
        for quantity in self.repeat:
            if quantity not in SAMPLED or quantity == "t":
                expected = ", ".join(name for name in SAMPLED if name != "t")
                raise InputError(
                    f"repeat: got {quantity!r}, expected a quantity of one period: {expected} (time goes on by itself)"
                )
        if self.header is not None and self.header != "none" and not (self.header.isdecimal() and int(self.header)):
            raise InputError(f"header: got {self.header!r}, expected the number of a line, from 1, or none")


_SECTIONS: dict[str, type] = {"columns": str, "units": str, "scale": float, "index": str, "files": str}
_SCALARS: dict[str, type] = {
    "dt_s": float, "sensor_late": int, "delimiter": str, "decimal": str, "repeat": list, "header": str,
}  # fmt: skip


def load_map(path: Path) -> ColumnMap:
    """Read a :class:`ColumnMap` from a TOML file with its field names as keys and tables.

    Columns may be given by number, and files relative to the map's folder. Raises InputError where the file is
    missing, is not TOML, or has an unknown key.
    """
    try:
        table = tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"map {path}: cannot be read ({error.strerror}); expected a TOML file") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise InputError(f"map {path}: is not TOML: {error}") from error
    values: dict[str, Any] = {}
    for key, value in table.items():
        if key in _SECTIONS and isinstance(value, dict):
            values[key] = {q: _typed(path, f"{key}.{q}", v, _SECTIONS[key]) for q, v in value.items()}
        elif key in _SCALARS:
            values[key] = _typed(path, key, value, _SCALARS[key])
        else:
            known = ", ".join([f"[{name}]" for name in _SECTIONS] + [*_SCALARS])
            raise InputError(f"map {path}: got unknown key {key!r}, expected {known}")
    if "files" in values:
        values["files"] = {quantity: path.parent / name for quantity, name in values["files"].items()}
    if "repeat" in values:
        values["repeat"] = tuple(str(_typed(path, "repeat", name, str)) for name in values["repeat"])
    return ColumnMap(**values)


def _typed(path: Path, key: str, value: object, kind: type) -> object:
    if kind is float and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    if (key == "header" or key.startswith("columns.")) and type(value) is int:
        return str(value)
    if not isinstance(value, kind) or isinstance(value, bool):
        raise InputError(f"map {path}: {key}: got {value!r}, expected {kind.__name__}")
    return value


def stated_unit(text: str) -> str | None:
    """The name in `QUANTITIES` of the unit ``text`` as programs and people write it; None where it is none."""
    if any(text in factors for _, factors in QUANTITIES.values()):
        return text
    return _UNIT_WORDS.get(text.casefold())


def is_unit(text: str) -> bool:
    """Whether ``text`` is a unit of any quantity."""
    return stated_unit(text) is not None


#: The unit at the end of a name: ``y_nm``, ``pos [nm]``, ``Voltage (V)``, ``t / ms``, ``Position, um``, ``t in ms``,
#: ``in s``, ``Time: s``, ``Time - s``, ``Time <s>``.
_UNIT_AT_END = re.compile(
    r"(?:_|[\s_]*[\[({<]\s*|\s*[/,:]\s*|\s+[-–]\s+|(?:^|\s+)in\s+)([°A-Za-zµμÂÎ¼è]+(?: C)?)\s*[\])}>]?\s*$"
)


def unit_of_name(quantity: str, column: str) -> str | None:
    """The unit at the end of a column's name (``_nm``, `` [nm]``, ``(nm)``, `` / nm``); None unless of the quantity."""
    factors = QUANTITIES[quantity][1]
    match = _UNIT_AT_END.search(column)
    unit = stated_unit(match.group(1)) if match else None
    return unit if unit in factors else None


def other_unit_of_name(quantity: str, column: str) -> str | None:
    """A unit at the end of a column's name that is none of the quantity, as the volts of a sensor; else None."""
    match = _UNIT_AT_END.search(column)
    unit = stated_unit(match.group(1)) if match else None
    return unit if unit is not None and unit not in QUANTITIES[quantity][1] else None


def default_column(source: str, quantity: str, names: list[str]) -> str | None:
    """The column with the name of the quantity, with or without a unit; None where there is none.

    Raises InputError where there are several.
    """
    canonical, _ = QUANTITIES[quantity]
    if canonical in names:
        return canonical
    with_unit = [n for n in names if n.startswith(f"{quantity}_") and n == f"{quantity}_{unit_of_name(quantity, n)}"]
    if len(with_unit) > 1:
        raise InputError(
            f"{source}: {quantity}: got columns {', '.join(with_unit)}, expected one: choose by --column {quantity}=..."
        )
    return with_unit[0] if with_unit else (quantity if quantity in names else None)


#: Quantities that a column may be by its unit alone.
BY_UNIT = ("t", "u", "y")


def column_by_unit(quantity: str, names: list[str], units: Mapping[str, str], taken: Collection[str]) -> str | None:
    """The only column in a unit of the quantity: ``Voltage (V)`` is ``u`` where no other column is in volts.

    ``units`` : name -> unit, where the file states it apart from the name. ``taken`` : columns of other quantities.
    None where there is no such column, or there are several. A displacement goes before an angle. The volts of a sensor
    are not ``u`` where another column, without a unit, may be.
    """
    factors = QUANTITIES[quantity][1]
    others = {canonical for canonical, _ in QUANTITIES.values()} | set(taken)
    free = {name: unit_of_name(quantity, name) or stated_unit(units.get(name, "")) for name in names}
    free = {name: unit for name, unit in free.items() if name not in others and not _is_phase(name)}
    found = [name for name, unit in free.items() if unit in _LENGTH] if quantity == "y" else []
    found = found or [name for name, unit in free.items() if unit in factors]
    if quantity not in BY_UNIT or len(found) != 1:
        return None
    if quantity == "u" and not may_be("u", found[0], free[found[0]]):
        unnamed = [n for n, unit in free.items() if unit is None and not other_unit_of_name("u", n)]
        if any(may_be("u", name, None) and name.casefold() not in TIME_WORDS for name in unnamed):
            return None
    return found[0]


#: Names of a time, in lower case.
TIME_WORDS = ("time", "zeit", "temps", "t", "x_value", "timestamp", "x", "x-axis", "x axis")
#: Words of a wanted value, which is no reading.
_WANTED = ("target", "command", "setpoint", "set point", "demand", "desired", "reference", "soll", "consigne")
#: Words of a reading, which drives nothing.
_READING = ("pos", "displ", "sensor", "weg", "auslenkung", "measured", "monitor")
#: Words in the names of columns, for a proposal that the user checks; never used without a word from the user. What
#: says as little as ``ch1`` or ``input`` is none: there the column that lags is the reading.
_WORDS = {
    "t": TIME_WORDS,
    "u": ("volt", "drive", "command", "spannung", "tension", "piezo", "dac"),
    "y": (*_READING, "adc"),
}


def named_column(quantity: str, names: list[str]) -> str | None:
    """The column with a word of the quantity in its name; None where there is none."""
    for word in _WORDS.get(quantity, ()):
        for name in names:
            if name.casefold() == word or (len(word) > 2 and word in name.casefold()):
                return name
    return None


def _is_phase(name: str) -> bool:
    """Whether a column is an amplifier's phase: an angle, and no tilt."""
    return "phase" in name.casefold()


def is_angle(unit: str) -> bool:
    """Whether a name in `QUANTITIES` is that of an angle."""
    return unit in _ANGLE


def may_be(quantity: str, name: str, unit: str | None) -> bool:
    """Whether a column may be proposed for ``u`` or ``y`` by its name and the unit that it states (None for none).

    A target is no reading, and drives only where it is in volts. A reading drives nothing. A sensor may be in a unit of
    another kind, with a factor.
    """
    wanted, reading = (any(word in name.casefold() for word in words) for words in (_WANTED, _READING))
    length, volts = unit in _LENGTH or unit in _ANGLE, unit in _VOLTAGE
    if unit in _TIME or unit in _TEMPERATURE or unit in _RATE or _is_phase(name):
        return False
    return not wanted if quantity.startswith("y") else (volts if wanted or length else not reading)


class MissingError(InputError):
    """Something that the user must say before a file can be read.

    Attributes
    ----------
    what : the same in a few words, for a list.
    options : the options to add as they are typed, with a proposal for each.
    """

    def __init__(self, message: str, what: str, *options: str) -> None:
        super().__init__(message)
        self.what = what
        self.options = options


def factor_and_unit(
    source: str, quantity: str, column: str, mapping: ColumnMap, stated: str | None = None
) -> tuple[float, str]:
    """Factor from the file's numbers to the canonical unit, and the name of the unit.

    ``stated`` is the unit that the file itself states for the column, apart from its name. Raises InputError where no
    unit is known, or the file's statement contradicts the name or the quantity, naming the file, the column, the
    accepted units and the option to add.
    """
    if quantity in mapping.scale:
        return mapping.scale[quantity], "scaled"
    canonical, factors = QUANTITIES[quantity]
    own = canonical.rsplit("_", 1)[1]
    accepted = f"expected one of {', '.join(factors)}: add --unit {quantity}={own} if it is in {own}" + (
        ", or --scale if it is of another kind" if quantity not in ("t", "dt", "rate") else ""
    )
    unit = mapping.units.get(quantity)
    if unit is None and stated:
        unit = stated if stated in factors else stated_unit(stated) or stated
        if unit not in factors:
            raise InputError(
                f"{source}: column {column!r} for {quantity}: the file states the unit {stated!r}, {accepted}"
            )
        named = unit_of_name(quantity, column)
        if named is not None and factors[named] != factors[unit]:
            raise InputError(
                f"{source}: column {column!r} for {quantity}: the file states the unit {stated!r} and its name says "
                f"{named}, expected the same: settle it with --unit {quantity}={unit} or {quantity}={named}"
            )
    unit = unit or unit_of_name(quantity, column)
    if unit is None and (other := other_unit_of_name(quantity, column)):
        raise MissingError(
            f"{source}: column {column!r} for {quantity} is in {other} by its name, {accepted}",
            f"the factor from {other} to {own} of column {column!r} for {quantity}",
            f"--scale {quantity}=FACTOR",
        )
    if unit is None:
        raise MissingError(
            f"{source}: column {column!r} for {quantity} has no unit in its name, and units are never guessed; "
            f"{accepted}",
            f"the unit of column {column!r} for {quantity}: {', '.join(factors)}",
            f"--unit {quantity}=UNIT",
        )
    return factors[unit], unit
