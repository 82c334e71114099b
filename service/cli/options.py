"""Options that several commands share, defined once, and what they mean to a command."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final

from dehyst.service.config.schema import Setting
from dehyst.service.protocol.errors import FieldError
from dehyst.service.protocol.keys import check_name

#: The note below examples that name files.
EXAMPLE_FILES: Final = "'dehyst stage --examples DIR' makes a folder with the files that these examples name.\n"

_SHARED: Final[dict[str, dict[str, Any]]] = {
    "stage": {"default": "demo", "metavar": "NAME", "help": "stage on the wire (%(default)s)"},
    "axis": {"default": "x", "metavar": "NAME", "help": "axis of the stage (%(default)s)"},
    "timeout": {
        "type": float, "default": 1.0, "metavar": "S", "help": "longest wait for an answer, s (%(default)s)",
    },
    "wait": {
        "type": float, "default": 0.0, "metavar": "S",
        "help": "how long to wait for the endpoint to come up, s (%(default)s)",
    },
    "zenoh-config": {"type": Path, "metavar": "FILE", "help": "zenoh's own configuration, for TLS"},
    "key": {
        "metavar": "FILE",
        "help": "the key that 'dehyst serve' prints, where it is not this user's own; -: check nothing (DEHYST_KEY)",
    },
    "insecure-beyond-loopback": {
        "action": "store_true", "help": "let everybody in who reaches an address on another machine",
    },
    "out": {"type": Path, "metavar": "DIR", "help": "folder for the results"},
    "seed": {"type": int, "default": 0, "metavar": "N", "help": "seed of the noise (%(default)s)"},
    "duration": {"type": float, "metavar": "S", "help": "end after this time, s"},
    "range": {"metavar": "START:STOP", "help": "the part of the recording to use, s"},
    "test": {"type": Path, "metavar": "FILE", "help": "another recording of the same stage"},
    "test-range": {"metavar": "START:STOP", "help": "the part of the test recording to use, s"},
    "quick": {"action": "store_true", "help": "fewer repetitions, rougher numbers"},
    "no-pictures": {"action": "store_true", "help": "draw nothing"},
    "json": {"action": "store_true", "help": "print JSON in place of the table"},
    "log-level": {
        "choices": ("debug", "info", "warning", "error"), "default": "warning",
        "help": "messages to stderr from this level on (%(default)s)",
    },
    "quiet": {"action": "store_true", "help": "print no progress"},
}  # fmt: skip
#: Further spellings of an option.
_ALSO: Final = {"no-pictures": ("--no-picture",)}


def add_shared(parser: Any, *names: str, **changes: Mapping[str, Any]) -> None:
    """Add the shared options ``names`` to a parser or a group of it.

    ``changes`` adds an option too, with other settings: ``axis={"default": "*"}``; an underscore stands for a hyphen.
    """
    for name in (*names, *(name.replace("_", "-") for name in changes)):
        settings = {**_SHARED[name], **changes.get(name.replace("-", "_"), {})}
        parser.add_argument(f"--{name}", *_ALSO.get(name, ()), **settings)


def add_connection(parser: Any, wait_s: float = 0.0, timeout_s: float | None = 1.0) -> None:
    """The options of a client: ``--endpoint --wait --zenoh-config --key``, and ``--timeout`` unless it is None."""
    from dehyst.service.runtime.session import DEFAULT_ENDPOINT

    parser.add_argument(
        "--endpoint",
        default=DEFAULT_ENDPOINT,
        metavar="ENDPOINT",
        help="zenoh endpoint of the service or router (%(default)s)",
    )
    if timeout_s is not None:
        add_shared(parser, timeout={"default": timeout_s})
    add_shared(parser, "zenoh-config", "key", wait={"default": wait_s})


def add_selection(parser: Any) -> None:
    """``--stage`` and ``--axis`` of a command that shows all axes by default; see `check_selection`."""
    add_shared(parser, stage={"default": "*", "help": "only this stage (all)"})
    add_shared(parser, axis={"default": "*", "help": "only this axis (all)"})


def check_selection(args: argparse.Namespace) -> None:
    """Raise InputError where a name of `add_selection` is none."""
    for option, given in (("--stage", args.stage), ("--axis", args.axis)):
        if given != "*":
            check_name(option, given)


def add_epilog(parser: argparse.ArgumentParser, text: str, files: bool = False) -> None:
    """Show ``text``, line by line as it is, below the options. ``files`` : its examples name files."""
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.epilog = text + ("\n" + EXAMPLE_FILES if files else "")


def progress_printer(quiet: bool, first: Callable[[], None] = lambda: None) -> Callable[[str], None]:
    """Prints a line of progress to stderr at once, so that stdout holds the result only; nothing if ``quiet``.

    ``first`` is called before each line; it may raise where a signal has come.
    """

    def say(line: str) -> None:
        first()
        if not quiet:
            print(line, file=sys.stderr, flush=True)

    return say


def check_number(option: str, value: float | None, unit: str = "", **bounds: Any) -> None:
    """Raise FieldError where ``value`` is outside ``bounds``: ``low``, ``high`` and ``above`` of `Setting`."""
    setting = Setting(unit=unit, **bounds)
    if value is not None and not setting.holds(value):
        raise FieldError(option, value, setting.range())


def check_seed(seed: int) -> int:
    """``seed``. Raises FieldError where it is negative."""
    check_number("--seed", seed, low=0)
    return seed
