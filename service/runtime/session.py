"""Opens zenoh sessions the way this project wants them: unicast, explicit endpoints, nothing beyond the machine.

Client programs use mode ``client``, because two peers behind one hub do not see each other while clients do. Every
session is to be closed by hand (``with``, or ``close()``): a callback left behind on an open session keeps the
interpreter from ending, and ``atexit`` comes too late for it.
"""

from __future__ import annotations

import ipaddress
import json
import os
import re
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import zenoh

from service.protocol.errors import FieldError, SessionError

DEFAULT_ENDPOINT: Final = "tcp/127.0.0.1:7447"
#: No hand-over between thread pools: halves the round trip (docs/protocol.md, "Latency"). More than one network thread,
#: because closing the connection of a receiver that was stopped holds one up for as long as ten seconds.
#: Sending has a thread of its own: a service passes messages on between its clients, and a receiver that waits
#: for room to send, on the very thread that would make that room, stops the whole service for good.
_RUNTIME: Final = (
    "(net:(worker_threads:3),app:(handover:net),acc:(handover:net),tx:(worker_threads:1),rx:(handover:net))"
)
#: A router reads from many and waits for many: who waits for one receiver must not keep the others from being read.
_ROUTER_RUNTIME: Final = "(rx:(worker_threads:16),tx:(worker_threads:4))"
_ENDPOINT = re.compile(
    r"(?P<proto>tcp|udp|tls|quic|ws)/(?P<host>\[[0-9a-fA-F:]+\]|[^/:\[\]]+):(?P<port>\d{1,5})(?:[?#].*)?\Z"
)
_LOCAL = re.compile(r"unixsock-stream/.+\Z")
_RETRY_S: Final = 0.05
_ROUTER_WAIT_S: Final = 10.0
#: Silence after which the other end of a connection is taken for dead, and longest time for opening one, s.
LEASE_S: Final = 1.0
_OPEN_S: Final = 1.0
#: Longest time that a receiver may take nothing at all, s.
_STUCK_S: Final = 0.3
#: By mode, s. A client has one other end only: nobody waits behind it. At a router it must be shorter than the lease,
#: because everybody's signs of life wait behind one slow subscriber when another one comes or goes.
_PATIENCE_S: Final = {"peer": _STUCK_S, "router": _STUCK_S, "client": 5.0}
#: Packets of 64 KiB that may wait at the priority of a state on its way to a standby; zenoh's default of two is full,
#: and the next part lost, where the thread that sends waits for a processor for a few milliseconds.
_STATE_PACKETS: Final = 16
#: The longest message that is put together from its parts, bytes: the largest model, and some. Zenoh's own default of
#: 1 GiB would let any sender ask for that much memory.
MAX_MESSAGE_BYTES: Final = 72 * 2**20


def check_endpoint(field: str, endpoint: object) -> str:
    """``endpoint`` if zenoh can listen at or connect to it, else InputError naming ``field``."""
    expected = "protocol/host:port such as tcp/127.0.0.1:7447"
    if not isinstance(endpoint, str):
        raise FieldError(field, repr(endpoint), expected)
    match = _ENDPOINT.match(endpoint)
    if not match and not _LOCAL.match(endpoint):
        raise FieldError(field, repr(endpoint), expected)
    if match and not 1 <= int(match["port"]) <= 65535:
        raise FieldError(field, repr(endpoint), "a port from 1 to 65535")
    return endpoint


def is_loopback(endpoint: str) -> bool:
    """Whether ``endpoint`` can be reached from this machine only."""
    match = _ENDPOINT.match(endpoint)
    if not match:
        return bool(_LOCAL.match(endpoint))
    host = match["host"].strip("[]")
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def open_service(
    listen: Sequence[str], connect: Sequence[str] = (), zenoh_config: Path | None = None, lease_s: float = LEASE_S
) -> zenoh.Session:
    """A peer that listens at ``listen`` and connects to ``connect`` (routers, other services).

    One that listens nowhere is a client of the first of ``connect`` that it reaches, and of another when that one
    goes: behind a router clients see each other, peers do not, and a service is to see its standby.
    ``zenoh_config`` is a JSON5 file of zenoh's own, for TLS, passwords and access control; what is given here goes
    over it. Raises SessionError where an endpoint cannot be had, such as a port in use, or no router is reached
    within ten seconds (hosts that start together may do so in any order).
    """
    if listen:
        return _open("peer", listen, connect, zenoh_config, lease_s)
    return _open_client(connect, _ROUTER_WAIT_S, zenoh_config, lease_s)


def open_router(listen: Sequence[str], connect: Sequence[str] = (), zenoh_config: Path | None = None) -> zenoh.Session:
    """A router: passes on between all that connect to it, and to the routers it connects to. Raises SessionError."""
    return _open("router", listen, connect, zenoh_config)


def open_client(
    endpoint: str | Sequence[str] = DEFAULT_ENDPOINT, wait_s: float = 0.0, zenoh_config: Path | None = None
) -> zenoh.Session:
    """A client connected to ``endpoint``, tried for ``wait_s`` seconds. Raises SessionError if nobody is there.

    Of several endpoints (a service and its standby) it is connected to the first that answers, and to another when
    that one goes.
    """
    return _open_client((endpoint,) if isinstance(endpoint, str) else tuple(endpoint), wait_s, zenoh_config)


def _open_client(
    connect: Sequence[str], wait_s: float, zenoh_config: Path | None, lease_s: float = LEASE_S
) -> zenoh.Session:
    read_zenoh_config(zenoh_config)  # a file that cannot be read is no reason to wait
    until = time.monotonic() + wait_s
    while True:
        try:
            return _open("client", (), connect, zenoh_config, lease_s)
        except SessionError:
            if time.monotonic() >= until:
                raise
            time.sleep(_RETRY_S)


def read_zenoh_config(path: Path | None) -> zenoh.Config:
    """Zenoh's own configuration from a JSON5 file, or its defaults for None. Raises SessionError.

    A relative path of the password file in it is taken from the folder of the file, not of the process.
    """
    if path is None:
        return zenoh.Config()
    try:
        config = zenoh.Config.from_file(path)
        dictionary = json.loads(config.get_json("transport/auth/usrpwd"))["dictionary_file"]
        if dictionary is not None and not Path(dictionary).is_absolute():
            absolute = path.resolve().parent / dictionary
            config.insert_json5("transport/auth/usrpwd/dictionary_file", json.dumps(str(absolute)))
    except zenoh.ZError as error:
        raise SessionError(f"{path}: not a configuration of zenoh: {_plain(error)}") from error
    return config


def _open(
    mode: str, listen: Sequence[str], connect: Sequence[str], zenoh_config: Path | None, lease_s: float = LEASE_S
) -> zenoh.Session:
    # Read once, when zenoh starts its threads, hence before the first session of the process.
    os.environ.setdefault("ZENOH_RUNTIME", _ROUTER_RUNTIME if mode == "router" else _RUNTIME)
    for endpoint in (*listen, *connect):
        check_endpoint("endpoint", endpoint)
    config = read_zenoh_config(zenoh_config)
    settings: dict[str, Any] = {
        "mode": mode,
        "listen/endpoints": list(listen),
        "connect/endpoints": list(connect),
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "transport/link/rx/max_message_size": MAX_MESSAGE_BYTES,
        # No faster here, and what a killed process had of it stays behind until /dev/shm is full.
        "transport/shared_memory/enabled": False,
        # Who is silent for so long is taken for dead; who died is known at once, by its closed connections.
        "transport/link/tx/lease": round(1e3 * lease_s),
        # A process that is stopped still accepts connections, but says nothing on them.
        "transport/unicast/open_timeout": round(1e3 * _OPEN_S),
        # Who takes nothing for so long is let go, so that samples on their way to others do not wait behind it, µs.
        "transport/link/tx/queue/congestion_control/block/wait_before_close": round(1e6 * _PATIENCE_S[mode]),
        "transport/link/tx/queue/size/data_low": _STATE_PACKETS,
        "connect/retry": {"period_init_ms": 20, "period_max_ms": 200, "period_increase_factor": 2},
    }
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    try:
        return zenoh.open(config)
    except zenoh.ZError as error:
        raise SessionError(_advice(str(error), listen, connect)) from error


def _advice(text: str, listen: Sequence[str], connect: Sequence[str]) -> str:
    if "Address already in use" in text:
        return f"cannot listen at {', '.join(listen)}: the port is in use; stop what holds it or choose another port"
    if "Unable to connect" in text:
        return (
            f"nobody listens at {', '.join(connect)}, or who does refuses this certificate or password: "
            "start 'dehyst serve' there, give its endpoint, or see docs/access.md"
        )
    return f"cannot open a zenoh session (listen {list(listen)}, connect {list(connect)}): {_plain(text)}"


def _plain(error: object) -> str:
    """A message of zenoh without the places in its sources."""
    return re.sub(r"\s+at \S+\.rs:\d+\.?", "", str(error)).strip()
