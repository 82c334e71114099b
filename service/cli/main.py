"""The command line: a table of commands, in groups. The module of a command is imported only when it is asked for."""

from __future__ import annotations

import argparse
import codecs
import importlib
import io
import logging
import os
import sys
from collections.abc import Collection, Mapping, Sequence
from difflib import get_close_matches
from importlib.util import find_spec
from typing import Any, Final, NamedTuple

from dehyst.adaptive.errors import DehystError
from dehyst.service.runtime.descriptors import too_many

# --- Which packages a command needs beyond those of the client, and the extra of the installation that brings them.

SERVE: Final = "serve"
VIEWER: Final = "viewer"
LAB: Final = "lab"
#: Import names of the packages that each extra of pyproject.toml brings. VIEWER and LAB bring those of SERVE too.
PACKAGES: Final[dict[str, tuple[str, ...]]] = {
    SERVE: ("numba", "scipy", "psutil", "threadpoolctl", "pyarrow", "shtab"),
    VIEWER: ("rerun",),
    LAB: ("matplotlib", "h5py", "nptdms", "openpyxl"),
    "torch": ("torch",),
    "peers": ("sklearn", "krls", "filterpy"),
}


def missing(extras: tuple[str, ...]) -> str:
    """The first package of ``extras`` that cannot be imported; "" where none is missing."""
    for extra in (SERVE, *extras) if extras else ():
        for package in PACKAGES[extra]:
            if not _is_there(package):
                return package
    return ""


def advice(package: str, extras: tuple[str, ...] = ()) -> str:
    """What to install for the import name ``package``; "" where no extra brings it.

    ``extras`` : those that the command needs, if it is known.
    """
    bring = extras or tuple(extra for extra, packages in PACKAGES.items() if package in packages)
    if not bring:
        return ""
    extra = f"[{','.join(bring)}]"
    return (
        f"needs the package {package}, which is not installed here: pip install 'dehyst{extra}' "
        f"(from a wheel: pip install 'dehyst-VERSION-py3-none-any.whl{extra}')"
    )


def _is_there(package: str) -> bool:
    try:
        return find_spec(package) is not None
    except ModuleNotFoundError:
        return False


# --- The commands.

SERVING: Final = "serving"
OPERATING: Final = "operating"
IDENTIFICATION: Final = "identification and diagnosis"
EXPERIMENTS: Final = "experiments"
OTHER: Final = "other"
GROUPS: Final = (SERVING, OPERATING, IDENTIFICATION, EXPERIMENTS, OTHER)

_EPILOG: Final = """\
dehyst COMMAND --help lists the options of a command. Exit status: 0 done, 1 failed on the way, 2 usage error,
130 interrupted.
"""


class Command(NamedTuple):
    """One command: a module with ``add_arguments(parser)`` and ``run(args) -> int``, its group, one line of help.

    The docstring of the module behind its title is shown below the options: notes, and examples of each use.

    ``extras`` : of the installation, without which it cannot do its work. ``compiles`` : whether it needs the compiled
    loops from the start.
    """

    module: str
    group: str
    help: str
    extras: tuple[str, ...] = ()
    compiles: bool = False


#: The commands by group, with one line of help each.
_HELP: Final = {
    SERVING: {
        "serve": "serve the inverse models of a stage over zenoh, and keep learning",
        "query": "ask a running service for voltages",
        "stage": "run a simulated stage as a process on zenoh",
        "router": "forward messages between stages, services and clients on several hosts",
        "view": "stream a running service to the Rerun viewer or into an .rrd file",
    },
    OPERATING: {
        "status": "show a live table of all axes and instances that serve",
        "metrics": "serve the status of all axes as metrics for Prometheus",
        "freeze": "stop an axis from learning, until it is thawed",
        "thaw": "let a frozen axis learn again",
        "rollback": "set the model of an axis back to a checkpoint",
        "checkpoints": "list the checkpoints of an axis",
        "select": "choose the model that answers where a query names none",
        "retune": "tune the learning model's hyper-parameters anew, in the background",
        "ask-diagnosis": "let a running service diagnose its recent samples, in the background",
        "epics": "show an axis as EPICS process variables, and take commands",
        "access": "make the certificates and access rules for more than one machine",
    },
    IDENTIFICATION: {
        "commission": "move a stage through its adapter, and identify it",
        "identify": "identify the inverse models of a stage from a recording",
        "export": "write a model as C, tables and an FMU, for use without the service",
        "look": "show what a file holds, and the command that would use it",
        "replay": "run the learner over a recording offline, with its decisions and errors",
        "diagnose": "name the effects in a recording that the simulation lacks, and what each explains",
        "modes": "find the modes of a stage in periodic recordings, and how they soften with amplitude",
    },
    OTHER: {
        "completion": "print the completion script of a shell",
    },
}
#: Modules that do not have the name of their command.
_MODULES: Final = {
    **dict.fromkeys(
        ("freeze", "thaw", "rollback", "checkpoints", "select", "retune", "ask-diagnosis"), "cli.commands.operate"
    ),
    "epics": "adapters.epics", "commission": "commissioning.command", "export": "export.command",
}  # fmt: skip
_EXTRAS: Final[dict[str, tuple[str, ...]]] = {
    **dict.fromkeys(("serve", "stage", "commission", "identify", "replay"), (SERVE,)),
    **dict.fromkeys(("look", "diagnose", "modes"), (LAB,)),
    "view": (VIEWER,),
}
_COMPILES: Final = frozenset({"serve", "stage", "commission", "identify", "replay", "diagnose", "modes"})
#: The commands that need nothing but the service. `lab.cli` adds the experiments.
COMMANDS: Final = {
    name: Command(
        f"dehyst.service.{_MODULES.get(name, f'cli.commands.{name}')}",
        group,
        line,
        _EXTRAS.get(name, ()),
        name in _COMPILES,
    )
    for group, lines in _HELP.items()
    for name, line in lines.items()
}


#: What a terminal or a pipe may be unable to show, as units have it on a keyboard; all else becomes a question mark.
_PLAIN: Final = str.maketrans({"µ": "u", "μ": "u", "²": "2", "°": "deg", "–": "-", "…": "..."})


def _plain(error: UnicodeError) -> tuple[str, int]:
    """Handler of encoding errors: characters that the encoding of an output lacks are spelt."""
    assert isinstance(error, UnicodeEncodeError)
    text = error.object[error.start : error.end].translate(_PLAIN)
    return text.encode("ascii", "replace").decode(), error.end


def main(argv: Sequence[str] | None = None, commands: Mapping[str, Command] = COMMANDS) -> int:
    """Run one command. Returns its exit status: 0 done, 1 failed on the way, 2 usage error, 130 interrupted.

    What the system refuses (a full disk, a folder that is read only, a closed pipe) is one line, not a traceback.
    """
    args = sys.argv[1:] if argv is None else list(argv)
    codecs.register_error("dehyst-plain", _plain)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="dehyst-plain")
    try:
        try:
            return _run(args, commands)
        finally:
            if sys.stdout is not None:
                sys.stdout.flush()
    except OSError as error:
        _give_up_stdout()
        logging.getLogger("dehyst").debug("refused by the system", exc_info=True)
        if not isinstance(error, BrokenPipeError):  # a closed pipe, as of head, wants no more
            command = next((a for a in args if not a.startswith("-")), "")
            print(f"dehyst {command}: {too_many(error) or error}", file=sys.stderr)
        return 1


def _give_up_stdout() -> None:
    """Point standard output to the null device once it takes no more, so that the exit does not fail."""
    try:
        sys.stdout.flush()
    except OSError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _run(args: list[str], commands: Mapping[str, Command]) -> int:
    # Before numpy is imported: a second BLAS thread now and then makes a solve of 1 ms wait for 65 ms.
    for variable in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"):
        os.environ.setdefault(variable, "1")
    chosen = next((a for a in args if not a.startswith("-")), None)
    known = chosen is not None and chosen in commands
    if chosen is not None and known and (package := missing(commands[chosen].extras)):
        print(f"dehyst {chosen}: {advice(package, commands[chosen].extras)}", file=sys.stderr)
        return 2
    parser = build_parser(commands, [chosen] if chosen is not None and known else [])
    if chosen is not None and not known:
        near = get_close_matches(chosen, commands, n=3)
        meant = f"did you mean {' or '.join(near)}? " if near else ""
        parser.error(
            f"COMMAND: got {chosen!r}; {meant}expected one of {', '.join(commands)}; options follow the command"
        )
    parsed = parser.parse_args(args, argparse.Namespace(given=args))
    from dehyst.service.runtime.logging_setup import set_up_logging

    set_up_logging(parsed.log_level)
    if key := vars(parsed).get("key"):
        os.environ["DEHYST_KEY"] = key  # for whatever this command starts, too
    if commands[parsed.command].compiles:
        from dehyst.service.warm import at_first_use

        at_first_use()
    try:
        return int(parsed.run(parsed))
    except DehystError as error:
        print(f"dehyst {parsed.command}: {error}", file=sys.stderr)
        return 2
    except ModuleNotFoundError as error:
        needed = advice((error.name or "").partition(".")[0])
        if not needed:
            raise
        print(f"dehyst {parsed.command}: {needed}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print(f"dehyst {parsed.command}: interrupted", file=sys.stderr)
        return 130


def build_parser(commands: Mapping[str, Command], loaded: Collection[str]) -> argparse.ArgumentParser:
    """The parser of the commands in ``loaded``, whose modules it imports; its help lists all ``commands``."""
    parser = argparse.ArgumentParser(
        prog="dehyst",
        usage="dehyst [-h] [--version] COMMAND ...",
        description="Takes the hysteresis out of piezo stages, and keeps it out.\n\n" + _listed(commands),
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action=_Version, nargs=0, help="print the version and exit")
    # The description lists the commands. With all of them loaded, for `dehyst completion`, nothing is hidden.
    hidden = argparse.SUPPRESS if len(loaded) < len(commands) else None
    sub = parser.add_subparsers(dest="command", required=True, prog="dehyst", metavar="COMMAND", help=hidden)
    for name in loaded:
        line = commands[name].help
        command = sub.add_parser(name, help=line, description=line[0].upper() + line[1:] + ".")
        _load(commands[name], command, commands)
    return parser


def _load(entry: Command, parser: argparse.ArgumentParser, commands: Mapping[str, Command]) -> None:
    from dehyst.service.cli.options import add_epilog, add_shared

    module = importlib.import_module(entry.module)
    # What the module says of itself, but for its title, is shown below the options.
    add_epilog(parser, (module.__doc__ or "").partition("\n\n")[2])
    module.add_arguments(parser)
    add_shared(parser, "log-level")
    parser.set_defaults(run=module.run, commands=commands)


def _listed(commands: Mapping[str, Command]) -> str:
    lines = []
    for group in GROUPS:
        entries = [f"  {name:<15}{entry.help}" for name, entry in commands.items() if entry.group == group]
        if entries:
            lines += [f"{group}:", *entries, ""]
    return "\n".join(lines).rstrip()


class _Version(argparse.Action):
    """Print the installed version and exit; looked up only then."""

    def __call__(self, parser: argparse.ArgumentParser, *_: Any, **__: Any) -> None:
        from importlib.metadata import PackageNotFoundError, version

        try:
            print(f"dehyst {version('dehyst')}")
        except PackageNotFoundError:
            print("dehyst, not installed: run from its sources")
        parser.exit()


if __name__ == "__main__":
    sys.exit(main())
