"""Reads one or several files into a recording with the project's columns and units."""

from __future__ import annotations

import gzip
import hashlib
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dehyst.adaptive.errors import InputError
from dehyst.adaptive.types import FloatArray
from dehyst.sim.recordings import array_formats as arrays
from dehyst.sim.recordings import delimited_text, json_arrays
from dehyst.sim.recordings.columns import (
    KELVIN_AT_0_C,
    QUANTITIES,
    SAMPLED,
    ColumnMap,
    MissingError,
    column_by_unit,
    default_column,
    factor_and_unit,
    is_angle,
)
from dehyst.sim.recordings.proposals import Candidate, likely, likely_time
from dehyst.sim.recordings.recording import Recording
from dehyst.sim.recordings.table import MAX_BYTES, Table
from dehyst.sim.recordings.text_cells import is_packed, opened_bytes

#: Two clocks agree within this share of a sample time.
CLOCK_TOLERANCE = 0.01


def read(path: Path | str, mapping: ColumnMap | None = None) -> Recording:
    """Read a file, or a folder of Parquet segments in the order of their names.

    The ending selects the format: ``.parquet``, ``.mat``, ``.h5``/``.hdf5``, ``.npz``, ``.npy``, ``.tdms``, ``.xlsx``.
    Other endings: by the first bytes. Any other file is delimited text. ``mapping.files`` names further files for
    single quantities; ``sha256`` then covers all of them.

    Raises InputError naming the file, what was found, what was expected, and the option that corrects it.
    """
    path, mapping = Path(path), mapping or ColumnMap()
    digest = hashlib.sha256()
    main = _main_table(path, mapping, digest)
    others: dict[Path, Table] = {}
    for file in mapping.files.values():
        if file not in others:
            others[file] = main if file == path else _table(file, digest, mapping)
    by_quantity = {quantity: others[file] for quantity, file in mapping.files.items()}
    return _Reading(main, by_quantity, mapping).recording(str(path), digest.hexdigest())


def read_table(path: Path, mapping: ColumnMap) -> Table:
    """The arrays of a file or a folder of segments, before their meaning is known. As `read`."""
    return _main_table(path, mapping, hashlib.sha256())


def sample_times(table: Table, mapping: ColumnMap, n: int) -> tuple[FloatArray, float]:
    """Time of each of ``n`` samples and the nominal sample time, s, from an option, a column, or the format."""
    reading = _Reading(table, {}, mapping)
    reading.names = {name: name for name in table.arrays}
    return reading._time(table.source, n)


def _main_table(path: Path, mapping: ColumnMap, digest: Any) -> Table:
    if path.is_dir():
        segments = sorted(path.glob("*.parquet"))
        if not segments:
            raise InputError(f"{path}: got a folder without .parquet files, expected a recording")
    else:
        segments = [path]
    tables = [_table(segment, digest, mapping) for segment in segments]
    return tables[0] if len(tables) == 1 else _joined(path, tables)


#: Beginning of a file by which its format is known, bytes.
_HEAD_BYTES = 1 << 16
#: Text takes several times the memory of its numbers.
_MOST_TEXT_BYTES = 4 * MAX_BYTES


def _head(path: Path, digest: Any) -> bytes:
    """The beginning of a file; ``digest`` takes all of it, in pieces. Raises InputError."""
    try:
        size, packed = path.stat().st_size, is_packed(path)
        if size <= _MOST_TEXT_BYTES:
            with path.open("rb") as file:
                hashlib.file_digest(file, lambda: digest)
        with opened_bytes(path) as file:
            head = file.read(_HEAD_BYTES)
            unpacked = len(head)
            while packed and unpacked <= _MOST_TEXT_BYTES and (piece := file.read(1 << 22)):
                unpacked += len(piece)
    except (EOFError, gzip.BadGzipFile, zlib.error) as error:
        raise InputError(f"{path}: is not a whole gzip file ({error}), expected one: pack it again") from error
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); expected a recording") from error
    if max(size, unpacked) > _MOST_TEXT_BYTES:
        most = _MOST_TEXT_BYTES / 1e9
        raise InputError(f"{path}: got more than {most:g} GB, expected at most that: cut it first")
    if not head:
        raise InputError(f"{path}: got an empty file, expected a recording")
    return head


def _content(path: Path) -> bytes:
    content = bytearray()
    with opened_bytes(path) as file:
        # In pieces: a read of so much takes the memory first, whatever the file holds.
        while len(content) <= MAX_BYTES and (piece := file.read(1 << 22)):
            content += piece
    if len(content) > MAX_BYTES:
        raise InputError(f"{path}: got more than {MAX_BYTES / 1e9:g} GB, expected at most that: cut it first")
    return bytes(content)


_BY_ENDING: dict[str, Callable[[Path, bytes], Table]] = {
    ".parquet": arrays.read_parquet,
    ".pq": arrays.read_parquet,
    ".mat": arrays.read_mat,
    ".h5": arrays.read_hdf5,
    ".hdf5": arrays.read_hdf5,
    ".npz": arrays.read_npz,
    ".npy": arrays.read_npy,
    ".tdms": arrays.read_tdms,
    ".feather": arrays.read_feather,
    ".arrow": arrays.read_feather,
    ".json": json_arrays.read_json,
    ".jsonl": json_arrays.read_json,
}
#: First bytes of a file -> its reader, for files with another ending.
_BY_FIRST_BYTES: dict[bytes, Callable[[Path, bytes], Table]] = {
    arrays.HDF5_SIGNATURE: arrays.read_hdf5,
    b"TDSm": arrays.read_tdms,
    b"\x93NUMPY": arrays.read_npy,
    b"PAR1": arrays.read_parquet,
    b"ARROW1": arrays.read_feather,
    b"MATLAB ": arrays.read_mat,
}
#: Formats to be saved as another one, with what to do.
_REFUSED = {
    ".xls": "an old Excel workbook, expected .xlsx or .csv: save it as one of these",
    ".tdms_index": "the index of a TDMS file, expected the .tdms file beside it",
    ".ods": "an OpenDocument sheet, expected .xlsx or .csv: save it as one of these",
    ".pkl": "a pickled Python object, which is never loaded: save its arrays as .npz or .csv",
}
#: First bytes of files that are no recordings, with what they are and what to do.
_REFUSED_BY_FIRST_BYTES: dict[bytes, str] = {
    b"PK\x03\x04": "a packed folder (zip): unpack it first",
    b"%PDF": "a PDF, expected the samples themselves: export them as .csv",
    b"\xd0\xcf\x11\xe0": "an old Office file, expected .xlsx or .csv: save it as one of these",
    b"SQLite format 3": "a database (SQLite): export its table as .csv",
    b"<!DOCTYPE": "a web page, expected the samples themselves: was the log-in of a server saved?",
    b"<html": "a web page, expected the samples themselves: was the log-in of a server saved?",
    b":WFM": "a scope's own waveform file: export it as .csv from the instrument or its program",
    b"WAVEDESC": "a scope's own waveform file: export it as .csv from the instrument or its program",
}


def _table(path: Path, digest: Any, mapping: ColumnMap) -> Table:
    ending = (path.with_suffix("") if path.suffix.lower() == ".gz" else path).suffix.lower()
    if ending in _REFUSED:
        raise InputError(f"{path}: is {_REFUSED[ending]}")
    table = _read_as(path, ending, _head(path, digest), mapping)
    if not table.arrays:
        raise InputError(f"{path}: holds no arrays of numbers, but {table.describe()}; expected one value per sample")
    return table


def _read_as(path: Path, ending: str, head: bytes, mapping: ColumnMap) -> Table:
    if ending in _BY_ENDING:
        return _BY_ENDING[ending](path, _content(path))
    if ending in (".xlsx", ".xlsm") or (head.startswith(b"PK\x03\x04") and b"[Content_Types].xml" in head):
        return arrays.read_xlsx(path, _content(path), mapping)
    for first, reader in _BY_FIRST_BYTES.items():
        # A text may begin with the same letters, and holds no zero bytes.
        if head.startswith(first) and b"\x00" in head[:4096]:
            return reader(path, _content(path))
    for first, what in _REFUSED_BY_FIRST_BYTES.items():
        if head.lstrip().startswith(first):
            raise InputError(f"{path}: is {what}")
    return delimited_text.read_delimited(path, head, mapping)


def _joined(path: Path, tables: list[Table]) -> Table:
    names = list(tables[0].arrays)
    for table in tables[1:]:
        if set(table.arrays) != set(names):
            raise InputError(
                f"{table.source}: got columns {table.describe()}, expected {', '.join(names)} as before it"
            )
    joined = {name: np.concatenate([table.arrays[name] for table in tables]) for name in names}
    return Table(str(path), joined, notes=(f"{len(tables)} segments",), units=tables[0].units)


class _Reading:
    """One recording on its way from tables to columns: which array is which quantity, and what was done to it."""

    def __init__(self, main: Table, by_quantity: dict[str, Table], mapping: ColumnMap) -> None:
        self.main = main
        self.by_quantity = by_quantity
        self.mapping = mapping
        #: All tables, the main one first, each once.
        self.tables = list({id(table): table for table in (main, *by_quantity.values())}.values())
        self.notes = [note for table in self.tables for note in table.notes]
        #: quantity -> name of its array in its table, for the columns that were read.
        self.names: dict[str, str] = {}
        #: Quantities that are angles.
        self.angles: list[str] = []
        #: Arrays that were proposed for quantities whose column is unknown.
        self._proposals: dict[str, Candidate] = {}

    def recording(self, source: str, sha256: str) -> Recording:
        """The columns under their names, all of one length. Raises InputError; MissingError with all that is
        missing.
        """
        columns: dict[str, NDArray[Any] | None] = {}
        missing: list[MissingError] = []
        for quantity in SAMPLED:
            if quantity != "t":
                try:
                    columns[quantity] = self._column(quantity, needed=quantity in ("u", "y"))
                except MissingError as error:
                    missing.append(error)
        if missing:
            missing += self._missing_time()
            raise missing[0] if len(missing) == 1 else _all_missing(source, self.main.describe(), missing)
        n = self._repeat(source, columns)
        named = {QUANTITIES[quantity][0]: values for quantity, values in columns.items()}
        named["t_s"], dt_s = self._time(source, n)
        if "seq" in self.main.arrays and self.main.arrays["seq"].dtype.kind in "iu":
            named["seq"] = self.main.arrays["seq"].astype(np.int64)
        if "reason" in self.main.arrays:
            named["reason"] = self.main.arrays["reason"].astype(np.str_)
        for name, values in named.items():
            if values is not None and len(values) != n:
                raise InputError(f"{source}: {name}: got {len(values)} samples, expected {n} as u_V and y_um")
        if self.mapping.sensor_late:
            named = _sensor_moved(source, named, self.mapping.sensor_late, n)
            self.notes.append(f"sensor's column moved back by {self.mapping.sensor_late} samples (sensor_late)")
        unit, notes = "µrad" if "y" in self.angles else "µm", tuple(self.notes)
        return Recording(dt_s=dt_s, source=source, sha256=sha256, notes=notes, y_unit=unit, **named)  # type: ignore[arg-type]

    def _name(self, quantity: str, table: Table) -> str | None:
        """The array of a quantity in its table: as the user says, by its name, or the only one that it can be."""
        said = self.mapping.columns.get(quantity)
        if said is not None:
            return table.named(quantity, said)
        name = default_column(table.source, quantity, list(table.arrays))
        # A format's own clock goes over a column in seconds.
        if name is None and table.positional and len(table.arrays) > 1 and not (quantity == "t" and table.clocks):
            name = column_by_unit(quantity, list(table.arrays), table.units, self._taken(table))
            if name is not None:
                self.notes.append(f"{quantity} is the column {name!r}, by its unit")
        only = self._only_array(table, quantity) if name is None else None
        if only is not None:
            # Quantities that can only mean this array: the user names the file or the part of the array for them, or
            # the other one of u and y is in another file.
            sharing = [q for q, other in self.by_quantity.items() if other is table and q not in self.mapping.columns]
            rest = [q for q in ("u", "y") if q not in self.by_quantity]
            if quantity in self.mapping.index or sharing == [quantity] or (table is self.main and rest == [quantity]):
                return only
        return name

    def _only_array(self, table: Table, quantity: str) -> str | None:
        """The array of a table with one, or with one beside the time, as of a scope that writes a file a channel."""
        names = list(table.arrays)
        if len(names) == 2 and table.positional and quantity != "t":
            time = likely_time(table)
            clock = self.mapping.columns.get("t") or (time.name if time else None)
            names = [name for name in names if name != clock]
        return names[0] if len(names) == 1 else None

    def _said_in(self, table: Table) -> list[str]:
        """The arrays of a table that the user has given to quantities."""
        said = [(q, n) for q, n in self.mapping.columns.items() if self.by_quantity.get(q, self.main) is table]
        return [table.named(quantity, name) for quantity, name in said]

    def _taken(self, table: Table) -> list[str]:
        """The arrays of a table that are quantities."""
        read = [name for q, name in self.names.items() if self.by_quantity.get(q, self.main) is table]
        return [*read, *self._said_in(table)]

    def _proposed(self, quantity: str, table: Table) -> tuple[str, ...]:
        """The options to add for a quantity whose column is unknown."""
        taken = {(name, "") for name in self._taken(table)} | {(p.name, p.index) for p in self._proposals.values()}
        if quantity == "t":
            time = likely_time(table)
            one = time if time and (time.name, time.index) not in taken else None
        else:
            one = likely(quantity, table, taken, self._drive(table) if quantity == "y" else None)
        if one is None:
            return ("--rate HZ",) if quantity == "t" else (f"--file {quantity}=FILE",)
        self._proposals[quantity] = one
        return self._with_unit(quantity, one, table)

    def _drive(self, table: Table) -> NDArray[Any] | None:
        """The voltage (n,) as far as it is known or proposed, in the file's numbers."""
        if "u" in self._proposals:
            return self._proposals["u"].values
        if "u" not in self.names or self.by_quantity.get("u", self.main) is not table:
            return None
        return table.column("u", self.names["u"], self.mapping.index.get("u"))[0]

    def _with_unit(self, quantity: str, one: Candidate, table: Table) -> tuple[str, ...]:
        """The options that make an array a quantity."""
        chosen = one.options(quantity)
        try:
            factor_and_unit(table.source, quantity, one.name, self.mapping, table.units.get(one.name))
        except MissingError as error:
            return (*chosen, *error.options)
        except InputError:  # in a unit of another kind: a sensor's volts
            return (*chosen, f"--scale {quantity}=FACTOR")
        return chosen

    def _missing_time(self) -> list[MissingError]:
        """What is missing for the time, where other things are missing too."""
        n = max((array.shape[0] for array in self.main.arrays.values() if array.ndim), default=0)
        try:
            if n > 1 and not self.main.clocks:
                self._time(self.main.source, n)
        except MissingError as error:
            return [error]
        except InputError:
            pass
        return []

    def _column(self, quantity: str, *, needed: bool) -> FloatArray | None:
        table = self.by_quantity.get(quantity, self.main)
        name = self._name(quantity, table)
        if name is None:
            if not needed and quantity not in self.by_quantity:
                return None
            canonical, factors = QUANTITIES[quantity]
            way = "NAME (or its position from 1)" if table.positional else "NAME"
            raise MissingError(
                f"{table.source}: got columns {table.describe()}, expected {canonical}: add --column {quantity}={way} "
                f"and, unless the name ends in one, its unit (--unit {quantity}=...: {', '.join(factors)}); if it is "
                f"in another file, --file {quantity}=FILE",
                f"which column is {canonical}, {WORDS.get(quantity, quantity)} (--column {quantity}={way}), and "
                f"its unit ({', '.join(factors)}); if it is in another file, --file {quantity}=FILE",
                *self._proposed(quantity, table),
            )
        self.names[quantity] = name
        return self._values(quantity, table, name)

    def _values(self, quantity: str, table: Table, name: str) -> FloatArray:
        factor, unit = factor_and_unit(table.source, quantity, name, self.mapping, table.units.get(name))
        values, done = table.column(quantity, name, self.mapping.index.get(quantity))
        if done:
            self.notes.append(done)
        if unit == "K":
            return values - KELVIN_AT_0_C
        if is_angle(unit):
            self.angles.append(quantity)
            self.notes.append(f"{quantity} is an angle: µrad stand where µm is written")
        return values if factor == 1.0 else values * factor

    def _repeat(self, source: str, columns: dict[str, NDArray[Any] | None]) -> int:
        """Repeat the periods in ``columns``. Returns the number of samples."""
        u, y = columns["u"], columns["y"]
        assert u is not None
        assert y is not None
        n = max(len(u), len(y))
        for quantity in self.mapping.repeat:
            period = columns[quantity]
            if period is None or not 0 < len(period) <= n:
                got = "no such column" if period is None else f"{len(period)} samples"
                raise InputError(f"{source}: repeat {quantity}: got {got}, expected one period of at most {n} samples")
            if len(period) < n:
                times = f"{n / len(period):.4g} times" + (", the last one in part" if n % len(period) else "")
                self.notes.append(f"{quantity}: its {len(period)} samples are one period and are repeated {times}")
                columns[quantity] = np.resize(period, n)
        u_n, y_n = len(columns["u"]), len(columns["y"])  # type: ignore[arg-type]
        if u_n != y_n:
            short, long, quantity = (u_n, y_n, "u") if u_n < y_n else (y_n, u_n, "y")
            whole = f", 1/{long // short} of the other" if short and long % short == 0 else ""
            raise InputError(
                f"{source}: got {u_n} samples of u_V and {y_n} of y_um, expected the same number: add --repeat "
                f"{quantity} if its {short} samples{whole} are one period of a periodic recording; otherwise cut or "
                "resample one of them"
            )
        return n

    def _time(self, source: str, n: int) -> tuple[FloatArray, float]:
        """Time of each sample and the nominal sample time, s, from an option, a column, or the format."""
        dt_s = self.mapping.dt_s
        if dt_s is None:
            t_s = self._clock_column(n)
            if t_s is not None:
                return t_s, nominal_dt(source, t_s)
            dt_s = self._stated_dt() or self._format_dt()
        if dt_s is None:
            raise MissingError(
                f"{self.main.source}: got columns {self.main.describe()} and no time, expected a column t_s: add "
                "--column t=NAME --unit t=..., or the sample time as --dt-s SECONDS or the rate as --rate HZ, or "
                "--column rate=NAME where the file holds a rate",
                "the time: which column it is and its unit, or the rate as --rate HZ",
                *self._proposed("t", self.main),
            )
        return np.arange(n, dtype=np.float64) * dt_s, float(dt_s)

    def _clock_column(self, n: int) -> FloatArray | None:
        """The time column (n,), s, of one of the files; all that there are must agree."""
        found: list[tuple[str, FloatArray]] = []
        if "t" in self.by_quantity:
            t_s = self._column("t", needed=True)
            assert t_s is not None
            found.append((self.by_quantity["t"].source, t_s))
        else:
            for table in self.tables:
                if (name := self._time_name(table)) is not None:
                    found.append((table.source, self._values("t", table, name)))
            if not found and "t" in self.mapping.columns:
                self.main.named("t", self.mapping.columns["t"])
        if not found:
            return None
        whole = [(where, t_s) for where, t_s in found if len(t_s) == n]
        for where, t_s in whole[1:]:
            dt_s = nominal_dt(whole[0][0], whole[0][1])
            apart = np.abs(t_s - whole[0][1])
            if np.nanmax(apart, initial=0.0) > CLOCK_TOLERANCE * dt_s:
                k = int(np.nanargmax(apart))
                raise InputError(
                    f"{where}: got the time {t_s[k]:.9g} s for sample {k + 1}, expected {whole[0][1][k]:.9g} s as in "
                    f"{whole[0][0]}: resample one of them; or if the samples belong together, say whose time is right "
                    "with --file t=FILE"
                )
        if not whole:
            where, t_s = found[0]
            raise InputError(
                f"{where}: t_s: got {len(t_s)} samples, expected {n} as u_V and y_um; of one period, give the rate as "
                "--rate HZ"
            )
        return whole[0][1]

    def _time_name(self, table: Table) -> str | None:
        """The array of the time in a table, if it has one."""
        said = self.mapping.columns.get("t")
        if said is None:
            return (
                self._name("t", table) if table is self.main else default_column(table.source, "t", list(table.arrays))
            )
        try:
            name = table.named("t", said)
        except InputError:
            if len(self.tables) == 1:
                raise
            return None
        # The position of the time in one file may be that of another quantity in the next one.
        taken = [self.names[q] for q in self.names if self.by_quantity.get(q, self.main) is table]
        return None if name in taken and "t" not in self.mapping.index else name

    def _stated_dt(self) -> float | None:
        """Sample time by a sample time or rate in a file, where the user names it or it has its canonical name."""
        found: list[tuple[str, float]] = []
        for quantity in ("dt", "rate"):
            said, canonical = self.mapping.columns.get(quantity), QUANTITIES[quantity][0]
            tables = [self.by_quantity[quantity]] if quantity in self.by_quantity else self.tables
            holding = [table for table in tables if (said or canonical) in table.arrays]
            if said is not None and not holding:
                tables[0].named(quantity, said)
            for table in holding or (tables if said is not None or quantity in self.by_quantity else []):
                name = self._name(quantity, table) or said or canonical
                value = table.scalar(quantity, name)
                value *= factor_and_unit(table.source, quantity, name, self.mapping, table.units.get(name))[0]
                if not 0.0 < value < 1e9:
                    raise InputError(f"{table.source}: {name}: got {value:g}, expected a positive number")
                found.append((f"{name} of {table.source}", value if quantity == "dt" else 1.0 / value))
        return self._agreed(found)

    def _format_dt(self) -> float | None:
        """Sample time by the formats; all channels must have the same, and start together."""
        found: list[tuple[str, float]] = []
        starts: list[tuple[str, float]] = []
        for quantity, name in self.names.items():
            table = self.by_quantity.get(quantity, self.main)
            dt_s, start_s = table.clocks.get(name, (None, None))
            if dt_s is not None:
                found.append((f"{name} of {table.source}", dt_s))
            if start_s is not None and quantity not in self.mapping.repeat:
                starts.append((f"{name} of {table.source}", start_s))
        dt_s = self._agreed(found)
        for where, start_s in starts[1:]:
            # Times since 1970 are good to a microsecond.
            if dt_s is not None and abs(start_s - starts[0][1]) > max(CLOCK_TOLERANCE * dt_s, 2e-6):
                raise InputError(
                    f"{where}: starts {round(start_s - starts[0][1], 6):+g} s after {starts[0][0]}, expected the same "
                    "start: cut them to the same times; or if the samples belong together, add --dt-s SECONDS"
                )
        if dt_s is not None:
            self.notes.append(f"sample time {dt_s:g} s as the file states it")
        return dt_s

    def _agreed(self, found: list[tuple[str, float]]) -> float | None:
        for where, dt_s in found[1:]:
            if abs(dt_s / found[0][1] - 1.0) > 1e-6:
                raise InputError(
                    f"{where}: got a sample time of {dt_s:.9g} s, expected {found[0][1]:.9g} s as {found[0][0]}: "
                    "resample one of them, or add --dt-s SECONDS if one of the two is wrong"
                )
        return found[0][1] if found else None


#: What the quantities are that every recording has, for people.
WORDS = {"t": "the time", "u": "the voltage", "y": "the displacement"}


def _all_missing(source: str, held: str, missing: list[MissingError]) -> MissingError:
    """One error for several things that are missing."""
    options = tuple(dict.fromkeys(option for error in missing for option in error.options))
    lines = [f"  {number}. {error.what}" for number, error in enumerate(missing, 1)]
    what = "\n".join(lines)
    message = f"{source}: got columns {held}, and units are never guessed. {len(missing)} things are missing:\n{what}"
    return MissingError(message, what, *options)


def _sensor_moved(
    source: str, columns: dict[str, NDArray[Any] | None], late: int, n: int
) -> dict[str, NDArray[Any] | None]:
    if late >= n:
        raise InputError(f"{source}: sensor_late: got {late} samples, expected fewer than the recording's {n}")
    sensors = ("y_um", "y2_um")
    return {
        name: None if values is None else (values[late:] if name in sensors else values[:-late])
        for name, values in columns.items()
    }


def nominal_dt(source: str, t_s: FloatArray) -> float:
    """Sample time from a time column (n,), s: the mean of the steps near the median. Raises InputError."""
    steps = np.diff(t_s)
    steps = steps[np.isfinite(steps) & (steps > 0.0)]
    if not len(steps):
        raise MissingError(
            f"{source}: t_s: got a time that never increases, expected increasing times in s: add --rate HZ or --dt-s",
            "the time, which never increases: the rate as --rate HZ",
            "--rate HZ",
        )
    rough = float(np.median(steps))
    # Gaps and doubled stamps would bias the mean.
    good = steps[np.abs(steps - rough) < 0.5 * rough]
    # Nine digits exceed the accuracy of any clock and remove round-off of the time column.
    return float(f"{np.mean(good) if len(good) else rough:.9g}")
