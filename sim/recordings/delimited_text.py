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
from dehyst.sim.recordings.columns import ColumnMap
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

#: Lines from which the layout is found; the same where these hold a long preamble only; and lines read at a time.
_HEAD_LINES: Final = 400
_LONG_HEAD_LINES: Final = 20_000
_BLOCK_ROWS: Final = 200_000
#: Delimiters in the order in which they are tried, with their names; a blank stands for any number of blanks.
_DELIMITERS: Final = {"\t": "tabs", ";": "';'", ",": "','", "|": "'|'", " ": "blanks"}
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
_DATE: Final = re.compile(r"(\d{4}-\d{2}-\d{2}(?:[T ]\d{2}:\d{2}(?::\d{2}(?:\.\d*)?)?)?) ?(?:Z|UTC|[+-]\d{2}:?\d{2})?")
#: What may stand between thousands, by the decimal sign, and a number with it.
_SEPARATORS: Final = {",": ".'\u2019\u00a0\u202f ", ".": ",'\u2019\u00a0\u202f "}
_THOUSANDS: Final = {
    sign: re.compile(rf"[+-]?[1-9]\d{{0,2}}([{between}])\d{{3}}(\1\d{{3}})*([{sign}]\d+)?")
    for sign, between in _SEPARATORS.items()
}


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
    """The rows of a head under one delimiter and decimal sign.

    first : index of the first line. kinds : of each column. rows : their number. grouped : whether thousands are
    separated.
    """

    delimiter: str
    decimal: str
    first: int
    kinds: str
    rows: int
    grouped: bool

    @property
    def rank(self) -> tuple[int, bool]:
        """The reading with the highest rank is taken: many numbers, no texts, and the plainer one of two."""
        return self.rows * (len(self.kinds.replace("e", "")) - 2 * self.kinds.count("t")), not self.grouped

    @property
    def columns(self) -> tuple[int, ...]:
        """Positions of the columns that are not empty, as behind a trailing delimiter and in front of a preamble."""
        return tuple(j for j, kind in enumerate(self.kinds) if kind != "e")


def find_layout(source: str, lines: list[str], encoding: str, mapping: ColumnMap) -> Layout:
    """The layout of a file by its first ``lines``. Raises InputError where it has none, or may be read in two ways."""
    named = _named_line(source, lines, mapping)
    found = [
        block
        for delimiter in ((mapping.delimiter,) if mapping.delimiter else _DELIMITERS)
        for decimal in ((mapping.decimal,) if mapping.decimal else (".", ","))
        # Numbers with a decimal comma between commas stand in quotes.
        if (not delimiter == decimal == "," or any('"' in line for line in lines))
        and (block := _block(lines, delimiter, decimal, named))
    ]
    best = max(found, key=lambda block: block.rank, default=None)
    if best is None or best.rank[0] <= 0:
        raise InputError(f"{source}: {_why_no_rows(lines, mapping)}")
    names, units, notes = _names(source, lines, mapping, best, named)
    kinds = "".join(best.kinds[j] for j in best.columns)
    return Layout(
        best.delimiter, best.decimal, best.first, len(best.kinds), best.columns, tuple(names), kinds, units,
        (*_said(encoding, best, mapping, lines), *notes),
    )  # fmt: skip


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


def _kind(cell: str, decimal: str) -> str:
    """n: number, e: empty or missing, d: a date or time of day, t: any other text."""
    if cell.casefold() in _MISSING:
        return "e"
    if _number(cell, decimal) is not None:
        return "n"
    return "d" if _DATE.fullmatch(cell) or _TIME_OF_DAY.fullmatch(cell) else "t"


def _number(cell: str, decimal: str) -> float | None:
    """A cell as a number, also one with its thousands separated; None where it is none."""
    plain = plain_number(cell)
    if _THOUSANDS[decimal].fullmatch(plain):
        plain = plain.translate(dict.fromkeys(map(ord, _SEPARATORS[decimal])))
    elif decimal == "," and "." in plain:
        return None
    return float(plain.replace(decimal, ".")) if is_number(plain, decimal) else None


def _block(lines: list[str], delimiter: str, decimal: str, named: int | None) -> _Block | None:
    """The rows at the end of a head; None where there are none with a number.

    The last rows tell the kinds of the columns. Every row further up with as many cells, a number in the first column
    of numbers and in half of the others is one of them: a wrong cell in it is a fault, not a preamble.
    """
    least = 0 if named is None else named + 1
    cells = [(k, split_cells(line, delimiter)) for k, line in enumerate(lines) if k >= least and not _is_comment(line)]
    rows = [(k, [_kind(cell, decimal) for cell in row]) for k, row in cells]
    while rows and "n" not in rows[-1][1]:  # names without samples, or a last row that was cut off
        rows.pop()
    if not rows:
        return None
    width = max(len(row) for _, row in rows[-2:] if "n" in row)
    same = [(k, kinds) for k, kinds in rows if len(kinds) == width]
    kinds = "".join(_common([row[j] for _, row in same[-10:]]) for j in range(width))
    numbers = [j for j in range(width) if kinds[j] == "n"]
    fits = [
        k
        for k, row in same
        if (row[numbers[0]] == "n" or kinds[: numbers[0]].strip("e"))
        and all(row[j] in "de" for j in range(width) if kinds[j] == "d")
        and 2 * sum(row[j] in "ne" for j in numbers) >= len(numbers)
        and any(row[j] == "n" for j in numbers)
    ] if numbers else []  # fmt: skip
    if not fits:
        return None
    grouped = any(_THOUSANDS[decimal].fullmatch(plain_number(cell)) for k, row in cells if k >= fits[0] for cell in row)
    return _Block(delimiter, decimal, fits[0], kinds, len(fits), grouped)


def _common(kinds: list[str]) -> str:
    """The kind of a column by those of its cells: the most frequent one that is not empty."""
    filled = [kind for kind in kinds if kind != "e"]
    return max(sorted(set(filled)), key=filled.count) if filled else "e"


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


def _fitting(line: str, block: _Block) -> list[str]:
    """The cells of a line above the samples, one for each column; none where they do not fit."""
    text, columns = line.strip("\r\n").lstrip("#% "), block.columns
    cells = split_cells(text.rstrip() if block.delimiter == " " else text, block.delimiter)
    while cells and not cells[-1]:
        cells.pop()
    if len(cells) != len(columns) and block.delimiter == " ":
        # Names with blanks in them stand further apart.
        cells = re.split(r"\s{2,}|\t", text.strip())
    if columns[-1] < len(cells) <= len(block.kinds) and all(cells[j] for j in columns):
        return [cells[j] for j in columns]
    return cells if len(cells) == len(columns) else []


def _names(
    source: str, lines: list[str], mapping: ColumnMap, block: _Block, named: int | None
) -> tuple[list[str], dict[str, str], list[str]]:
    """Names and units of the columns by the lines above the samples, and what to tell the user."""
    above = [k for k in range(block.first) if lines[k].strip()]
    stated: int | None = None
    if named is None and above:
        named = above[-1]
        # Above a row of units stand the names, also such as are numbers of channels.
        if len(above) > 1 and _units(lines, block, *above[-2:]):
            named, stated = above[-2:]
    elif named is None:
        if len(block.columns) == len(block.kinds):
            _refuse_unclear(source, split_cells(lines[block.first], block.delimiter), mapping, block.first + 1)
    elif named >= 0:
        stated = next((k for k in above if k > named), None)
    names = _fitting(lines[named], block) if named is not None and named >= 0 else []
    if mapping.header not in (None, "none") and not names:
        raise InputError(
            f"{source}: is not a table of {len(split_cells(lines[named or 0], block.delimiter))} columns as line "
            f"{mapping.header} names them: the rows below have {len(block.columns)}"
        )
    notes: list[str] = []
    if mapping.header is None and stated is None and named is not None:
        names = _sure_names(source, lines, mapping, block, above, names)
        if names and _is_comment(lines[named]):
            notes.append(f"columns named by the comment above the samples: {', '.join(names)}")
    if not names:
        without = "no names of columns in the file: they are called by their position, from 1"
        return [str(j + 1) for j in block.columns], {}, [without]
    units = {} if named is None or stated is None else _units(lines, block, named, stated)
    if units and stated is not None:
        listed = ", ".join(f"{name} in {unit}" for name, unit in units.items())
        notes.append(f"units from line {stated + 1}: {listed}")
    return different(names), units, notes


def _units(lines: list[str], block: _Block, named: int, stated: int) -> dict[str, str]:
    """name -> unit, where line ``named`` holds names and line ``stated`` units; else empty."""
    names = _fitting(lines[named], block)
    return units_row(different(names), _fitting(lines[stated], block)) if names and all(names) else {}


def _sure_names(
    source: str, lines: list[str], mapping: ColumnMap, block: _Block, above: list[int], cells: list[str]
) -> list[str]:
    """``cells`` of the line directly above the samples where they are names, else none. Raises InputError."""
    last = above[-1]
    numbers = any(is_number(cell, block.decimal) for cell in cells)
    if len(cells) > 2 and not cells[0] and all(cells[1:]) and not numbers:
        # As pandas writes its index: the first column has no name.
        cells = ["index", *cells[1:]]
    if not cells or not all(cells):
        _refuse_commas_between_commas(source, lines[last], block)
        return []
    if _is_comment(lines[last]):
        return [] if len(set(cells)) < len(cells) or any(is_number(cell, ".") for cell in cells) else cells
    if numbers and all(_is_comment(lines[k]) for k in above[:-1]):
        _refuse_unclear(source, cells, mapping, last + 1)
    return [] if numbers or any(_kind(cell, block.decimal) == "d" for cell in cells) else cells


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
    names = split_cells(line.strip("\r\n"), block.delimiter)
    if block.delimiter == "," and 2 * len(names) == len(block.kinds) > 2 and not any(is_number(n, ".") for n in names):
        raise InputError(
            f"{source}: got {len(names)} names and {len(block.kinds)} cells a line, expected as many: decimal commas "
            "between commas cannot be told apart; save it with ';' between the columns, or with points"
        )


def _said(encoding: str, block: _Block, mapping: ColumnMap, lines: list[str]) -> list[str]:
    """What was found and is not the plainest case, as a note."""
    found = []
    if encoding not in ("utf-8", "utf-8-sig"):
        found.append(f"letters in {encoding.upper()}")
    if mapping.delimiter is None and block.delimiter != "," and len(block.kinds) > 1:
        found.append(f"columns separated by {_DELIMITERS[block.delimiter]}")
    if mapping.decimal is None and block.decimal == ",":
        found.append("decimal commas")
    if block.grouped:
        found.append("thousands separated")
    preamble = sum(not _is_comment(line) for line in lines[: block.first])
    if preamble > 2:
        found.append(f"samples from line {block.first + 1} on, below {preamble} lines of a preamble")
    return ["text: " + ", ".join(found)] if found else []


# --- The rows.


class _Rows:
    """Collects the columns of a file, block by block."""

    def __init__(self, source: str, layout: Layout) -> None:
        self.source, self.layout = source, layout
        self.n = 0
        self.notes: list[str] = []
        self._line = layout.start
        #: By column its blocks of numbers or of texts; numbers have dtype object where a cell is none.
        self._blocks: list[list[NDArray[Any]]] = [[] for _ in layout.names]

    def add(self, lines: list[str], *, last: bool) -> None:
        """Take the next lines of the file; ``last`` says that there are no more."""
        numbered, kinds = self._line, self.layout.kinds
        self._line += len(lines)
        block: FloatArray | list[NDArray[Any]] | None = self._fast(lines)
        if block is None:
            rows = self._cells(lines, numbered, last)
            texts = [[row[j] for row in rows] for j in self.layout.columns]
            block = [
                self._numbers(cells) if kind == "n" else np.array(cells)
                for kind, cells in zip(kinds, texts, strict=True)
            ]
        self.n += len(block[0])
        if self.n * 8 * len(kinds) > MAX_BYTES:
            raise InputError(
                f"{self.source}: takes more than {MAX_BYTES / 1e9:g} GB of memory, expected at most that: cut it, or "
                "leave out columns that are not needed"
            )
        for blocks, values in zip(self._blocks, block, strict=True):
            blocks.append(np.ascontiguousarray(values))

    def _fast(self, lines: list[str]) -> FloatArray | None:
        """(k, n) numbers by the compiled reader; None where a line is not k numbers."""
        layout, decimal = self.layout, self.layout.decimal
        # A point beside decimal commas separates thousands.
        points = decimal == "," and (layout.delimiter == "," or any("." in line for line in lines))
        if layout.kinds.strip("n") or points or all(not line.strip() for line in lines):
            return None
        delimiter = None if layout.delimiter == " " else layout.delimiter
        count = layout.width - 1
        if delimiter and any(line.count(delimiter) != count for line in lines if line.strip()):
            return None
        source = (line.replace(",", ".") for line in lines) if decimal == "," else lines
        usecols = None if len(layout.columns) == layout.width else layout.columns
        try:
            table = np.loadtxt(source, delimiter=delimiter, comments=None, quotechar='"', ndmin=2, usecols=usecols)
        except ValueError:
            return None
        return table.T if table.shape[1] == len(layout.columns) else None

    def _cells(self, lines: list[str], numbered: int, last: bool) -> list[list[str]]:
        """The cells of the rows, the first of which is line ``numbered`` + 1. Raises InputError on a wrong row."""
        layout, rows = self.layout, list[list[str]]()
        for k, line in enumerate(lines, numbered + 1):
            if _is_comment(line):
                continue
            cells = split_cells(line.strip("\r\n"), layout.delimiter)
            whole = layout.columns[-1] < len(cells) and not any(cells[layout.width :])
            if whole:
                rows.append(cells + [""] * (layout.width - len(cells)))
            elif last and k == numbered + len(lines) and len(cells) < layout.width and not line.endswith("\n"):
                self.notes.append(f"the last line ({k}) is cut off and left out")
            else:
                raise InputError(
                    f"{self.source}: is not a table of {len(layout.columns)} columns: line {k} has {len(cells)} cells "
                    f"({line.strip()[:60]!r}), expected {layout.width}"
                )
        return rows

    def _numbers(self, cells: list[str]) -> NDArray[Any]:
        """Cells as numbers (n,), NaN where there is none; a cell that is no number stays as it is."""
        decimal = self.layout.decimal
        with contextlib.suppress(ValueError):
            if decimal == "." or not any("." in cell for cell in cells):
                return np.array([cell.replace(decimal, ".") for cell in cells], dtype=np.float64)
        values: list[Any] = []
        for cell in cells:
            value = _number(cell, decimal)
            values.append(value if value is not None else np.nan if cell.casefold() in _MISSING else cell)
        return np.array(values, dtype=object if any(isinstance(value, str) for value in values) else np.float64)

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
        for name, kind, blocks in zip(layout.names, layout.kinds, self._blocks, strict=True):
            found[name] = np.concatenate(blocks)
            blocks.clear()
            if kind != "n" and (times := _times(found[name].tolist())) is not None:
                found[name], units[name] = times, "s"
        return Table(self.source, found, notes=(*layout.notes, *self.notes), units=units, positional=True)


def _times(cells: list[str]) -> FloatArray | None:
    """Dates or times of day (n,) as seconds since the first; None where they are other texts."""
    filled = [cell for cell in cells if cell]
    dates = [_DATE.fullmatch(cell) for cell in cells]
    if filled and all(date for cell, date in zip(cells, dates, strict=True) if cell):
        try:
            return seconds(np.array([date[1] if date else "NaT" for date in dates], dtype="datetime64[ns]"))
        except ValueError:
            return None
    if not filled or not all(_TIME_OF_DAY.fullmatch(cell) for cell in filled):
        return None
    of_day = np.array([_second_of_day(cell) for cell in cells])
    # Midnight is no step back.
    days = np.concatenate([[0.0], np.cumsum(np.diff(of_day) < -43_200.0)]) * 86_400.0
    return np.asarray(of_day + days - of_day[0])


def _second_of_day(cell: str) -> float:
    match = _TIME_OF_DAY.fullmatch(cell)
    if match is None:
        return np.nan
    hour = int(match[1]) if match[4] is None else int(match[1]) % 12 + 12 * (match[4] in "Pp")
    return 3600.0 * hour + 60.0 * int(match[2]) + float(match[3].replace(",", ".").replace(":", "."))
