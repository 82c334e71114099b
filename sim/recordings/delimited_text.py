"""Delimited text: its encoding, delimiter, decimal sign and first row are found, and it is read in blocks.

The first lines of a file decide its layout. The table is read by numpy's compiled reader in one thread: the reader of
pyarrow starts threads that can abort the process when it ends soon after a refused file.
"""

from __future__ import annotations

import contextlib
import itertools
import re
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from dehyst.adaptive.errors import InputError
from dehyst.adaptive.types import FloatArray
from dehyst.sim.recordings.columns import ColumnMap, stated_unit
from dehyst.sim.recordings.table import MAX_BYTES, Table, seconds
from dehyst.sim.recordings.text_cells import (
    different,
    encoding_of,
    is_number,
    opened,
    plain_number,
    split_cells,
    units_row,
)

#: Lines from which the layout is found, and rows that are converted at a time.
_HEAD_LINES: Final = 400
#: The same where these hold a long preamble only.
_LONG_HEAD_LINES: Final = 20_000
_BLOCK_ROWS: Final = 200_000
#: Delimiters in the order in which they are tried; a blank stands for any number of blanks.
_DELIMITERS: Final = ("\t", ";", ",", "|", " ")
_NAMES: Final = {"\t": "tabs", ";": "';'", ",": "','", "|": "'|'", " ": "blanks"}
#: Words for a missing value.
_MISSING: Final = frozenset({
    "", "na", "n/a", "#n/a", "nan", "-nan", "1.#qnan", "-1.#ind", "null", "none", "-", "--", "---", "----", "*",
    "ovrng", "overrange", "over range", "overload", "overflow", "ol", "out of range", "invalid", "error",
    "\N{INFINITY}", "-\N{INFINITY}", "+\N{INFINITY}",
})  # fmt: skip
#: A time of day, also behind a date in any order of day, month and year, which only a midnight would need.
_TIME_OF_DAY: Final = re.compile(
    r"(?:\d{1,4}[-./]\d{1,2}[-./]\d{1,4}[ T]+)?(\d{1,2}):(\d{2}):(\d{2}(?:[.,:]\d*)?)(?: ?([AaPp])[Mm])?"
)
#: A number with thousands separated, by its decimal sign. ``1.000`` alone is one only where points are no decimals.
_THOUSANDS: Final = {
    ",": re.compile(r"[+-]?[1-9]\d{0,2}((\.\d{3}){2,}(,\d+)?|(\.\d{3})+,\d+|(['\u2019\u00a0\u202f ]\d{3})+(,\d+)?)"),
    ".": re.compile(r"[+-]?[1-9]\d{0,2}((,\d{3}){2,}(\.\d+)?|(,\d{3})+\.\d+|(['\u2019\u00a0\u202f ]\d{3})+(\.\d+)?)"),
}
_ONE_THOUSAND: Final = {",": re.compile(r"[+-]?[1-9]\d{0,2}\.\d{3}"), ".": re.compile(r"[+-]?[1-9]\d{0,2},\d{3}")}
#: What separates thousands, with its name for people.
_SEPARATORS: Final = {
    ".": "points", ",": "commas", "'": "apostrophes", "\u2019": "apostrophes", "\u00a0": "blanks",
    "\u202f": "blanks", " ": "blanks",
}  # fmt: skip
_DATE: Final = re.compile(r"(\d{4}-\d{2}-\d{2}(?:[T ]\d{2}:\d{2}(?::\d{2}(?:\.\d*)?)?)?) ?(?:Z|UTC|[+-]\d{2}:?\d{2})?")


@dataclass(frozen=True, slots=True)
class Layout:
    """How a file of delimited text is laid out.

    Attributes
    ----------
    delimiter : between its cells, a blank for any blanks. decimal : "." or ",".
    start : number of lines above the first sample. width : cells in a row.
    columns : position from 0 of each column. names : its name. kinds : "n" for numbers, "d" for times, "t" for texts.
    units : name -> unit, where a row below the names states it. notes : what was found, for people.
    """

    delimiter: str
    decimal: str
    start: int
    width: int
    columns: tuple[int, ...]
    names: tuple[str, ...]
    kinds: str
    units: dict[str, str] = field(default_factory=dict)
    notes: tuple[str, ...] = ()


def read_delimited(path: Path, head: bytes, mapping: ColumnMap) -> Table:
    """Delimited text: one row per sample, below a preamble, names and units where it has them. ``head``: its beginning.

    Lines of names and units directly above the samples are used; columns without names are called by their position
    from 1. Raises InputError where the first line may be names as well as a sample, and where a row does not fit.
    """
    encoding = encoding_of(path, head)
    try:
        return _read(str(path), lambda: opened(path, encoding), encoding, mapping)
    except UnicodeDecodeError:
        # The beginning was plain, a later letter is not UTF-8: an instrument of one byte a letter.
        return _read(str(path), lambda: opened(path, "latin-1"), "latin-1", mapping)


def read_lines(source: str, lines: list[str], mapping: ColumnMap) -> Table:
    """A table from lines that are read already; ``source`` for messages. Otherwise as `read_delimited`."""
    return _read(source, lambda: contextlib.nullcontext(iter(lines)), "utf-8", mapping)


def _read(
    source: str, lines: Callable[[], AbstractContextManager[Iterator[str]]], encoding: str, mapping: ColumnMap
) -> Table:
    with lines() as file:
        head = list(itertools.islice(file, _HEAD_LINES))
        try:
            layout = find_layout(source, head, encoding, mapping)
        except InputError:
            more = list(itertools.islice(file, _LONG_HEAD_LINES))
            if not more:
                raise
            layout = find_layout(source, head + more, encoding, mapping)
    rows = _Rows(source, layout)
    with lines() as file:
        for _ in range(layout.start):
            next(file, None)
        while block := list(itertools.islice(file, _BLOCK_ROWS)):
            rows.add(block, last=len(block) < _BLOCK_ROWS)
    return rows.table()


# --- The layout.


@dataclass(frozen=True, slots=True)
class _Block:
    """The rows of a head under one delimiter and decimal sign: the first line of them, and the kind of each column."""

    delimiter: str
    decimal: str
    first: int
    kinds: str
    rows: int


def find_layout(source: str, lines: list[str], encoding: str, mapping: ColumnMap) -> Layout:
    """The layout of a file by its first ``lines``. Raises InputError where it has none, or may be read in two ways."""
    if not any(line.strip() for line in lines):
        raise InputError(f"{source}: got no data, expected a header line and one row per sample")
    named = _named_line(source, lines, mapping)
    delimiters = (mapping.delimiter,) if mapping.delimiter else _DELIMITERS
    decimals = (mapping.decimal,) if mapping.decimal else (".", ",")
    found = [
        block
        for delimiter in delimiters
        for decimal in decimals
        # Numbers with a decimal comma between commas stand in quotes.
        if (not delimiter == decimal == "," or any('"' in line for line in lines))
        and (block := _block(lines, delimiter, decimal, named))
    ]
    # The reading with the most numbers; of equal ones the first. One with more texts than numbers is none.
    best = max(found, key=_numbers, default=None)
    if best is None or _numbers(best) <= 0:
        raise InputError(f"{source}: {_why_no_rows(lines, mapping)}")
    return _layout(source, lines, encoding, mapping, best, named)


def _named_line(source: str, lines: list[str], mapping: ColumnMap) -> int | None:
    """The index of the line of names that the user states, -1 for a table without names, None where nothing is said."""
    if mapping.header is None:
        return None
    if mapping.header == "none":
        return -1
    index = int(mapping.header) - 1
    if index >= len(lines) or not lines[index].strip():
        where = f"beyond the {len(lines)} lines of the file" if index >= len(lines) else "empty"
        raise InputError(
            f"{source}: header: got line {mapping.header}, which is {where}, expected the line with the columns' names"
        )
    return index


def _is_comment(line: str) -> bool:
    return line.lstrip()[:1] in ("#", "%") or not line.strip()


def _kind(cell: str, decimal: str, grouped: bool = False) -> str:
    """n: number, e: empty or missing, d: a date or time of day, t: any other text.

    ``grouped`` : whether other cells show that thousands are separated.
    """
    if cell.casefold() in _MISSING:
        return "e"
    if (not (decimal == "," and "." in cell) and is_number(cell, decimal)) or _grouped(cell, decimal, grouped):
        return "n"
    return "d" if any(times.fullmatch(cell) for times in (_DATE, _TIME_OF_DAY)) else "t"


def _grouped(cell: str, decimal: str, known: bool) -> bool:
    """Whether a cell is a number with its thousands separated; ``known``: others show that they are."""
    plain = plain_number(cell)
    return bool(_THOUSANDS[decimal].fullmatch(plain) or (known and _ONE_THOUSAND[decimal].fullmatch(plain)))


def _block(lines: list[str], delimiter: str, decimal: str, named: int | None) -> _Block | None:
    """The rows at the end of a head; None where there are none with a number.

    The last rows tell the kinds of the columns. Every row further up with as many cells, a number in the first column
    of numbers and in half of the others is one of them: a wrong cell in it is a fault, not a preamble.
    """
    least = 0 if named is None else named + 1
    cells = [(k, split_cells(line, delimiter)) for k, line in enumerate(lines) if k >= least and not _is_comment(line)]
    grouped = any(_grouped(cell, decimal, False) for _, row in cells for cell in row)
    rows = [(k, [_kind(cell, decimal, grouped) for cell in row]) for k, row in cells]
    while rows and "n" not in rows[-1][1]:  # names without samples, or a last row that was cut off
        rows.pop()
    if not rows:
        return None
    width = len(rows[-1][1])
    if len(rows) > 1 and width < len(rows[-2][1]) and "n" in rows[-2][1]:
        width = len(rows[-2][1])
    same = [(k, kinds) for k, kinds in rows if len(kinds) == width]
    kinds = "".join(_common([row[j] for _, row in same[-10:]]) for j in range(width))
    numbers = [j for j in range(width) if kinds[j] == "n"]
    if not numbers:
        return None
    fits = [
        k
        for k, row in same
        if (row[numbers[0]] == "n" or kinds[: numbers[0]].strip("e"))
        and all(row[j] in "de" for j in range(width) if kinds[j] == "d")
        and 2 * sum(row[j] in "ne" for j in numbers) >= len(numbers)
        and any(row[j] == "n" for j in numbers)
    ]
    return _Block(delimiter, decimal, fits[0], kinds, len(fits)) if fits else None


def _common(kinds: list[str]) -> str:
    """The kind of a column by those of its cells: the most frequent one that is not empty."""
    filled = [kind for kind in kinds if kind != "e"]
    return max(sorted(set(filled)), key=filled.count) if filled else "e"


def _numbers(block: _Block) -> int:
    return block.rows * (len(block.kinds.replace("e", "")) - 2 * block.kinds.count("t"))


def _why_no_rows(lines: list[str], mapping: ColumnMap) -> str:
    filled = [line for line in lines if not _is_comment(line)]
    if not filled:
        return "got no data, expected a header line and one row per sample"
    if len(filled) == 1:
        delimiter = mapping.delimiter or next((d for d in _DELIMITERS if d in filled[0].strip()), " ")
        width = len(split_cells(filled[0], delimiter))
        return f"is not a table of {width} columns: the file has a header line and no samples"
    return (
        f"got no rows of numbers in its first {len(lines)} lines (the last one is {filled[-1].strip()[:80]!r}), "
        "expected one row per sample; if something else than tabs, ';', ',' or blanks separates the columns, add "
        "--delimiter"
    )


def _layout(
    source: str, lines: list[str], encoding: str, mapping: ColumnMap, block: _Block, named: int | None
) -> Layout:
    # A trailing delimiter makes an empty last column; a preamble in front of the samples empty first ones.
    columns = tuple(j for j, kind in enumerate(block.kinds) if kind != "e") or tuple(range(len(block.kinds)))
    start = block.first
    above = [k for k in range(start) if lines[k].strip()]
    notes: list[str] = []
    names: list[str] | None = None
    units: dict[str, str] = {}
    if named is None and above:
        names, units, notes = _names_above(source, lines, mapping, block, columns, above)
    elif named is None:
        first = split_cells(lines[start], block.delimiter)
        if len(columns) == len(block.kinds):
            _refuse_unclear(source, first, mapping, start + 1)
    elif named >= 0:
        cells = _cells_of(lines[named], block.delimiter, strip=True)
        stated = _fitting(cells, block, columns)
        if stated is None:
            raise InputError(
                f"{source}: is not a table of {len(cells)} columns as line {named + 1} names them: the rows below have "
                f"{len(columns)}"
            )
        names = different(stated)
        below = next((k for k in above if k > named), None)
        units = {} if below is None else units_row(names, _fit(lines[below], block, columns))
        if units and below is not None:
            notes.append(_units_note(below, units))
    if names is None:
        names = [str(j + 1) for j in columns]
        notes.append("no names of columns in the file: they are called by their position, from 1")
    kinds = "".join(block.kinds[j] if block.kinds[j] != "e" else "n" for j in columns)
    said = _said(encoding, block, mapping, start, above, lines)
    separators = {
        _SEPARATORS[sign]
        for line in lines[start:]
        for cell in split_cells(line.strip("\r\n"), block.delimiter)
        if _grouped(cell, block.decimal, False)
        for sign in _SEPARATORS.keys() - {block.decimal}
        if sign in cell
    }
    if separators:
        notes.append(f"thousands separated by {', '.join(sorted(separators))}")
    return Layout(
        block.delimiter, block.decimal, start, len(block.kinds), columns, tuple(names), kinds, units, (*said, *notes)
    )  # fmt: skip


def _cells_of(line: str, delimiter: str, *, strip: bool = False) -> list[str]:
    cells = split_cells(line.strip("\r\n").lstrip("#% ") if strip else line, delimiter)
    while cells and not cells[-1]:
        cells.pop()
    return cells


def _fitting(cells: list[str], block: _Block, columns: tuple[int, ...]) -> list[str] | None:
    """The name of each column from the cells of a line; None where they do not fit."""
    if len(cells) == len(columns):
        return cells
    if columns[-1] < len(cells) <= len(block.kinds) and all(cells[j] for j in columns):
        return [cells[j] for j in columns]
    return None


def _fit(line: str, block: _Block, columns: tuple[int, ...]) -> list[str]:
    found = _fitting(_cells_of(line, block.delimiter, strip=True), block, columns)
    if found is None and block.delimiter == " ":
        # Names with blanks in them stand further apart; SPEC's begin with #L.
        text = line.strip().removeprefix("#L ").lstrip("#% ")
        found = _fitting(re.split(r"\s{2,}|\t", text), block, columns)
    return found or []


def _names_above(
    source: str, lines: list[str], mapping: ColumnMap, block: _Block, columns: tuple[int, ...], above: list[int]
) -> tuple[list[str] | None, dict[str, str], list[str]]:
    """Names and units of the columns from the lines directly above the samples, and what to tell the user."""
    last = above[-1]
    cells = _fit(lines[last], block, columns)
    if len(cells) > 2 and not cells[0] and all(cells[1:]) and not any(is_number(cell, ".") for cell in cells):
        # As pandas writes its index: the first column has no name.
        cells[0] = "index"
    if named := _names_and_units(lines, block, columns, above):
        return named
    if not cells or not all(cells):
        _refuse_commas_between_commas(source, lines[last], block)
        return None, {}, []
    if lines[last].lstrip()[:1] in ("#", "%"):
        if len(set(cells)) < len(cells) or any(is_number(cell, ".") for cell in cells):
            return None, {}, []
        return cells, {}, [f"columns named by the comment above the samples: {', '.join(cells)}"]
    if any(is_number(cell, block.decimal) for cell in cells):
        if all(_is_comment(lines[k]) for k in above[:-1]):
            _refuse_unclear(source, cells, mapping, last + 1)
        return None, {}, []
    if any(_kind(cell, block.decimal) == "d" for cell in cells):
        return None, {}, []
    return different(cells), {}, []


def _refuse_unclear(source: str, cells: list[str], mapping: ColumnMap, number: int) -> None:
    """Raise InputError where line ``number``, the first of the table, may be names as well as a sample."""
    filled = [cell for cell in cells if cell]
    numbers = [cell for cell in filled if is_number(cell, mapping.decimal)]
    counted = numbers in ([str(k + origin) for k in range(len(cells))] for origin in (0, 1))
    if numbers and (counted or len(numbers) < len(filled)):
        raise InputError(
            f"{source}: got {', '.join(filled)[:80]} in line {number}, which may be names of columns or a sample: add "
            f"--header {number} if it holds the columns' names, or --header none if it is a sample"
        )


def _refuse_commas_between_commas(source: str, line: str, block: _Block) -> None:
    """Raise InputError where each name stands above two cells: numbers with decimal commas between commas."""
    names = _cells_of(line, block.delimiter)
    if block.delimiter == "," and 2 * len(names) == len(block.kinds) > 2 and not any(is_number(n, ".") for n in names):
        raise InputError(
            f"{source}: got {len(names)} names and {len(block.kinds)} cells a line, expected as many: decimal commas "
            "between commas cannot be told apart; save it with ';' between the columns, or with points"
        )


def _names_and_units(
    lines: list[str], block: _Block, columns: tuple[int, ...], above: list[int]
) -> tuple[list[str], dict[str, str], list[str]] | None:
    """Names above a row of units: directly above the samples, or further up where every column has a unit."""
    for k, (named, stated) in reversed(list(enumerate(itertools.pairwise(above), 2))):
        upper = _fit(lines[named], block, columns)
        if not upper or not all(upper):
            continue
        names = different(upper)
        units = units_row(names, _fit(lines[stated], block, columns))
        # Above a whole row of units, numbers are names of channels.
        plain = not any(is_number(cell, block.decimal) for cell in upper)
        whole = len(units) == len(names) and all(map(stated_unit, units.values()))
        if whole or (units and plain and k == len(above)):
            return names, units, [_units_note(stated, units)]
    return None


def _units_note(line: int, units: dict[str, str]) -> str:
    return f"units from line {line + 1}: {', '.join(f'{name} in {unit}' for name, unit in units.items())}"


def _said(
    encoding: str, block: _Block, mapping: ColumnMap, start: int, above: list[int], lines: list[str]
) -> list[str]:
    """What was found and is not the plainest case, as a note."""
    found = []
    if encoding not in ("utf-8", "utf-8-sig"):
        found.append(f"letters in {encoding.upper()}")
    if mapping.delimiter is None and block.delimiter != "," and len(block.kinds) > 1:
        found.append(f"columns separated by {_NAMES[block.delimiter]}")
    if mapping.decimal is None and block.decimal == ",":
        found.append("decimal commas")
    preamble = [k for k in above if not _is_comment(lines[k])]
    if len(preamble) > 2:
        found.append(f"samples from line {start + 1} on, below {len(preamble)} lines of a preamble")
    return ["text: " + ", ".join(found)] if found else []


# --- The rows.


class _Rows:
    """Collects the columns of a file, block by block."""

    def __init__(self, source: str, layout: Layout) -> None:
        self.source, self.layout = source, layout
        self.n = 0
        self.notes: list[str] = []
        self._line = layout.start
        self._numbers = [i for i, kind in enumerate(layout.kinds) if kind == "n"]
        #: By column: the blocks of its numbers, or its texts.
        self._blocks: dict[int, list[FloatArray]] = {i: [] for i in self._numbers}
        self._texts: dict[int, list[str]] = {i: [] for i, kind in enumerate(layout.kinds) if kind != "n"}
        #: Cells that are no numbers in columns of numbers: column -> row -> text.
        self._wrong: dict[int, dict[int, str]] = {}
        self._whole = len(self._numbers) == layout.width

    def add(self, lines: list[str], *, last: bool) -> None:
        """Take the next lines of the file; ``last`` says that there are no more."""
        numbered = self._line
        self._line += len(lines)
        block = None if self._texts else self._fast(lines)
        if block is None:
            block = self._slow(lines, numbered, last)
        self.n += block.shape[1]
        if self.n * 8 * max(1, len(self._numbers)) > MAX_BYTES:
            raise InputError(
                f"{self.source}: takes more than {MAX_BYTES / 1e9:g} GB of memory, expected at most that: cut it, or "
                "leave out columns that are not needed"
            )
        for i, values in zip(self._numbers, block, strict=True):
            self._blocks[i].append(np.ascontiguousarray(values))

    def _fast(self, lines: list[str]) -> FloatArray | None:
        """(k, n) numbers by the compiled reader; None where a line is not k numbers."""
        layout = self.layout
        first = next((line for line in lines if line.strip()), None)
        if first is None:
            return np.empty((len(self._numbers), 0))
        delimiter = None if layout.delimiter == " " else layout.delimiter
        if not self._whole and delimiter is not None:
            count = layout.width - 1
            if any(line.count(delimiter) != count for line in lines if line.strip()):
                return None
        # A point beside decimal commas separates thousands.
        if layout.delimiter == layout.decimal or (layout.decimal == "," and any("." in line for line in lines)):
            return None
        source = (line.replace(",", ".") for line in lines) if layout.decimal == "," else lines
        usecols = None if self._whole else [layout.columns[i] for i in self._numbers]
        try:
            table = np.loadtxt(source, delimiter=delimiter, comments=None, quotechar='"', ndmin=2, usecols=usecols)
        except ValueError:
            return None
        return table.T if table.shape[1] == len(self._numbers) else None

    def _slow(self, lines: list[str], numbered: int, last: bool) -> FloatArray:
        """The same cell by cell: empty ones become NaN, texts are kept, and a wrong row is named."""
        layout = self.layout
        rows: list[list[str]] = []
        for k, line in enumerate(lines, numbered + 1):
            if _is_comment(line):
                continue
            cells = split_cells(line.strip("\r\n"), layout.delimiter)
            if len(cells) > layout.width and not any(cells[layout.width :]):
                cells = cells[: layout.width]
            if len(cells) < layout.width and layout.columns[-1] < len(cells):
                cells += [""] * (layout.width - len(cells))
            if len(cells) != layout.width:
                if last and k == numbered + len(lines) and len(cells) < layout.width and not line.endswith("\n"):
                    self.notes.append(f"the last line ({k}) is cut off and left out")
                    continue
                raise InputError(
                    f"{self.source}: is not a table of {len(layout.columns)} columns: line {k} has {len(cells)} cells "
                    f"({line.strip()[:60]!r}), expected {layout.width}"
                )
            rows.append(cells)
        block = np.empty((len(self._numbers), len(rows)))
        for at, i in enumerate(self._numbers):
            block[at] = self._column(i, [row[layout.columns[i]] for row in rows])
        for i, texts in self._texts.items():
            texts.extend(row[layout.columns[i]] for row in rows)
        return block

    def _column(self, i: int, cells: list[str]) -> FloatArray:
        comma = self.layout.decimal == ","
        if not (comma and any("." in cell for cell in cells)):
            try:
                return np.array([cell.replace(",", ".") for cell in cells] if comma else cells, dtype=np.float64)
            except ValueError:
                pass
        values = np.full(len(cells), np.nan)
        for row, cell in enumerate(cells):
            value = _number(cell, self.layout.decimal)
            if value is not None:
                values[row] = value
            elif cell.casefold() not in _MISSING:
                self._wrong.setdefault(i, {})[self.n + row] = cell
        return values

    def table(self) -> Table:
        """The columns by name; times of day and dates are seconds. Raises InputError where there are no rows."""
        layout = self.layout
        if not self.n:
            raise InputError(
                f"{self.source}: is not a table of {len(layout.columns)} columns: the file has a header line and no "
                "samples"
            )
        found: dict[str, NDArray[Any]] = {}
        units = dict(layout.units)
        for i, name in enumerate(layout.names):
            if i in self._texts:
                found[name], times = _times_or_texts(self._texts[i])
                if times:
                    units[name] = "s"
                continue
            values: NDArray[Any] = np.concatenate(self._blocks.pop(i))
            if i in self._wrong:
                values = values.astype(object)
                for row, text in self._wrong[i].items():
                    values[row] = text
            found[name] = values
        return Table(self.source, found, notes=(*layout.notes, *self.notes), units=units, positional=True)


def _number(cell: str, decimal: str) -> float | None:
    """A cell as a number; None where it is none."""
    plain = plain_number(cell)
    if _grouped(cell, decimal, True):
        plain = "".join(sign for sign in plain if sign == decimal or sign not in _SEPARATORS)
    elif decimal == "," and "." in plain:
        return None
    try:
        return float(plain.replace(",", ".") if decimal == "," else plain)
    except ValueError:
        return None


def _times_or_texts(cells: list[str]) -> tuple[NDArray[Any], bool]:
    """Dates or times of day (n,) as seconds since the first and True, or the texts and False."""
    filled = [cell for cell in cells if cell]
    dates = [_DATE.fullmatch(cell) for cell in cells]
    if filled and all(date for cell, date in zip(cells, dates, strict=True) if cell):
        try:
            return seconds(np.array([date[1] if date else "NaT" for date in dates], dtype="datetime64[ns]")), True
        except ValueError:
            return np.array(cells), False
    if filled and all(_TIME_OF_DAY.fullmatch(cell) for cell in filled):
        of_day = np.array(list(_seconds_of_day(cells)))
        # Midnight is no step back.
        days = np.concatenate([[0.0], np.cumsum(np.diff(of_day) < -43_200.0)]) * 86_400.0
        return of_day + days - of_day[0], True
    return np.array(cells), False


def _seconds_of_day(cells: list[str]) -> Iterator[float]:
    for cell in cells:
        match = _TIME_OF_DAY.fullmatch(cell)
        if match is None:
            yield np.nan
            continue
        hour = int(match[1]) if match[4] is None else int(match[1]) % 12 + 12 * (match[4] in "Pp")
        yield 3600.0 * hour + 60.0 * int(match[2]) + float(match[3].replace(",", ".").replace(":", "."))
