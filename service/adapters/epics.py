"""``dehyst epics``: one axis of a service as EPICS process variables, over PVAccess, through `p4p`.

The variables are PREFIX:STATUS, :TRUST, :MODEL_ERROR, :SAMPLE, :SERVED and, to be written, :FREEZE and :ENABLE.
PVAccess knows no passwords: everybody who reaches the address may freeze the axis. Needs p4p (pip install p4p).

  dehyst epics --prefix LAB:STAGE:X
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Callable
from typing import Any, Final

import zenoh

from dehyst.adaptive.errors import DehystError
from dehyst.service.adapters.adapter import load_library
from dehyst.service.cli.options import add_connection, add_shared, check_number
from dehyst.service.operating.remote import operate, statuses
from dehyst.service.protocol.errors import FieldError, ServiceError
from dehyst.service.protocol.keys import AUTO, Keys
from dehyst.service.runtime.session import is_loopback, open_client
from dehyst.service.runtime.stopping import StopSignal
from dehyst.service.security.authenticator import own_authenticator

#: The model that ENABLE = 0 serves.
PLAIN: Final = "linear"
_OK, _MAJOR, _INVALID = 0, 2, 3
#: Type of p4p and unit of the variables, and their initial values by type.
_VARIABLES: Final = {
    "STATUS": ("s", ""), "TRUST": ("d", ""), "MODEL_ERROR": ("d", "%"), "SAMPLE": ("l", ""), "SERVED": ("s", ""),
    "FREEZE": ("?", ""), "ENABLE": ("?", ""),
}  # fmt: skip
_INITIAL: Final[dict[str, Any]] = {"s": "", "d": math.nan, "l": -1, "?": False}


class EpicsAxis:
    """The process variables of one axis. Use as a context manager, and call :meth:`poll` once a period.

    | variable | type | |
    |---|---|---|
    | ``PREFIX:STATUS`` | string | ``ok``, ``stale``, ``frozen``, ``no_service``, or the name of the trouble |
    | ``PREFIX:TRUST`` | double | weight of the learning model, 0 to 1 |
    | ``PREFIX:MODEL_ERROR`` | double, % | recent error of the learning model, in percent of the voltage span |
    | ``PREFIX:SAMPLE`` | long | number of the last sample that the service has handled |
    | ``PREFIX:SERVED`` | string | the model that answers where a query names none |
    | ``PREFIX:FREEZE`` | bool, writable | 1 stops learning, 0 lets it go on |
    | ``PREFIX:ENABLE`` | bool, writable | 0 serves the mean gain (``linear``), 1 the model that was served before |

    Variables of an axis whose service does not answer have the alarm INVALID. Sources: documentation of p4p 4.

    Parameters
    ----------
    session, keys : of the service. prefix : of the variables' names.
    interface, port : where PVAccess listens; port 0 takes a free one. isolate : do not announce it to the network.

    Raises AdapterError if p4p is missing.
    """

    def __init__(
        self, session: zenoh.Session, keys: Keys, prefix: str, interface: str = "127.0.0.1", port: int = 5075,
        timeout_s: float = 2.0,
    ) -> None:  # fmt: skip
        self._session, self._keys, self._timeout_s = session, keys, timeout_s
        self._by = own_authenticator()
        server = load_library("p4p.server", "p4p")
        threads = load_library("p4p.server.thread", "p4p")
        scalars = load_library("p4p.nt", "p4p")
        self._variables: dict[str, Any] = {}
        #: The model that ENABLE = 1 serves.
        self._enabled_model = AUTO
        provider = server.StaticProvider("dehyst")
        for name, (kind, unit) in _VARIABLES.items():
            initial = {"value": _INITIAL[kind]} | ({"display.units": unit} if unit else {})
            variable = threads.SharedPV(nt=scalars.NTScalar(kind, display=kind in "dl"), initial=initial)
            self._variables[name] = variable
            provider.add(f"{prefix}:{name}", variable)
        for name, command in (("FREEZE", self._freeze), ("ENABLE", self._enable)):
            self._variables[name].put(_handler(command))
        local = {
            "EPICS_PVAS_INTF_ADDR_LIST": interface, "EPICS_PVAS_SERVER_PORT": str(port),
            "EPICS_PVAS_BROADCAST_PORT": str(port + 1 if port else 0),
            "EPICS_PVAS_AUTO_BEACON_ADDR_LIST": "NO", "EPICS_PVAS_BEACON_ADDR_LIST": interface,
        }  # fmt: skip
        self._server = server.Server(providers=[provider], conf=local, useenv=False)

    def __enter__(self) -> EpicsAxis:
        return self

    def __exit__(self, *_: object) -> None:
        self._server.stop()

    @property
    def configuration(self) -> dict[str, str]:
        """Settings of the server, by the names of EPICS (``EPICS_PVAS_SERVER_PORT``, ...)."""
        return dict(self._server.conf())

    def poll(self) -> str:
        """Read the status of the axis once and post it; returns what STATUS shows."""
        try:
            status = self._status()
        except ServiceError as error:
            for name, variable in self._variables.items():
                shown = "no_service" if name == "STATUS" else variable.current().raw.value
                self._post(name, shown, _INVALID, str(error))
            return "no_service"
        shown = str(status["trouble"] or ("frozen" if status["frozen"] else "stale" if status["stale"] else "ok"))
        severity = _OK if shown in ("ok", "frozen") else _MAJOR
        served = str(status["served"])
        if served != PLAIN:
            self._enabled_model = served
        error_pct = (status["quality"] or {}).get("recent_rms_error_pct")
        values = {
            "STATUS": shown,
            "TRUST": float(status["trust"]),
            "MODEL_ERROR": math.nan if error_pct is None else float(error_pct),
            "SAMPLE": int(status["seq"]),
            "SERVED": served,
            "FREEZE": bool(status["frozen"]),
            "ENABLE": served != PLAIN,
        }
        for name, value in values.items():
            self._post(name, value, severity, "" if severity == _OK else shown)
        return shown

    def _status(self) -> dict[str, Any]:
        for status in statuses(self._session, self._keys.stage, self._keys.axis, self._timeout_s, self._by):
            if "trust" in status:
                return status
        raise ServiceError(f"{self._keys.base}: no reply within {self._timeout_s:g} s; is the service running?")

    def _post(self, name: str, value: Any, severity: int, message: str) -> None:
        now_unix_s = time.time()
        self._variables[name].post(value, timestamp=now_unix_s, severity=severity, message=message[:80])

    def _freeze(self, on: bool) -> None:
        operate(self._session, self._keys, "freeze" if on else "thaw", "epics", None, self._timeout_s, self._by)
        self.poll()

    def _enable(self, on: bool) -> None:
        model = self._enabled_model if on else PLAIN
        operate(self._session, self._keys, "select", "epics", {"model": model}, self._timeout_s, self._by)
        self.poll()


def _handler(command: Callable[[bool], None]) -> Callable[[Any, Any], None]:
    def put(_: Any, operation: Any) -> None:
        try:
            command(bool(operation.value()))
        except DehystError as error:
            operation.done(error=str(error))
        else:
            operation.done()

    return put


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of ``dehyst epics``."""
    add = parser.add_argument
    add("--prefix", required=True, metavar="NAME", help="of the variables' names, such as LAB:STAGE:X")
    add_shared(parser, "stage", "axis")
    add_connection(parser, wait_s=10.0, timeout_s=2.0)
    add("--interface", default="127.0.0.1", metavar="ADDRESS", help="address where PVAccess listens (%(default)s)")
    add("--port", type=int, default=5075, metavar="N", help="its TCP port; names are searched at the next one (5075)")
    add("--every", type=float, default=1.0, metavar="S", help="time between two readings of the status, s (1.0)")
    add_shared(parser, "insecure-beyond-loopback", "duration")


def run(args: argparse.Namespace) -> int:
    """Serve the variables until Ctrl-C or SIGTERM. Returns 0."""
    stop = StopSignal()
    check_number("--every", args.every, "s", low=0, above=True)
    check_number("--port", args.port, low=1, high=65_534)
    if not args.insecure_beyond_loopback and not is_loopback(f"tcp/{args.interface}:{args.port}"):
        raise FieldError(
            "--interface", repr(args.interface), "an address of this machine, such as 127.0.0.1",
            "PVAccess has no passwords: with --insecure-beyond-loopback everybody there may freeze the axis",
        )  # fmt: skip
    keys = Keys(args.stage, args.axis)
    with (
        open_client(args.endpoint, args.wait, args.zenoh_config) as session,
        EpicsAxis(session, keys, args.prefix, args.interface, args.port, args.timeout) as axis,
    ):
        shown = axis.poll()
        print(f"ready: {args.prefix}:STATUS {shown} at {args.interface}, port {args.port}", flush=True)
        for _ in stop.every(args.every, args.duration):
            axis.poll()
    return 0
