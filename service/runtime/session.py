"""Opens zenoh sessions: unicast, explicit endpoints, no discovery, loopback unless configured otherwise.

Client programs use the mode ``client``: two peers connected to one hub do not see each other, clients do. Close every
session (``with``, or ``close()``): a callback on an open session keeps the interpreter from exiting, and ``atexit``
runs too late to close it.
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

from dehyst.service.protocol.errors import FieldError, SessionError
from dehyst.service.runtime.descriptors import too_few

# --- Delivery of messages that are sent only once, and whether a publisher has subscribers.

#: For messages that are sent only once. Zenoh's default drops a message silently if two others wait and the sending
#: thread gets no processor for a millisecond: 0.2 to 7 % of bursts of five small messages on two busy cores.
SURELY: Final = zenoh.CongestionControl.BLOCK
_PAUSE_S: Final = 0.01


def is_followed(publisher: Any) -> bool:
    """Whether ``publisher`` has subscribers, as far as its session knows."""
    status = publisher.matching_status
    # By its type stub a plain truth value; in this release an object that is always true.
    return status if isinstance(status, bool) else bool(status.matching)


def wait_followed(publisher: Any, within_s: float) -> bool:
    """Wait up to ``within_s`` s for a subscriber of ``publisher``; whether there is one."""
    until = time.monotonic() + within_s
    while not is_followed(publisher):
        if time.monotonic() >= until:
            return False
        time.sleep(_PAUSE_S)
    return True


# --- Sessions.

DEFAULT_ENDPOINT: Final = "tcp/127.0.0.1:7447"
#: No hand-over between thread pools: that halves the round trip (docs/protocol.md, "Connecting"). More network threads,
#: because closing the connection to a stopped receiver blocks one of them for up to ten seconds. Sending has its own
#: thread: a service forwards messages between its clients, and if the receiving thread also had to free the send
#: queue it waits for, the service would deadlock.
_RUNTIME: Final = (
    "(net:(worker_threads:3),app:(handover:net),acc:(handover:net),tx:(worker_threads:1),rx:(handover:net))"
)
#: A router serves many connections. Waiting for one slow receiver must not stop it from reading the others.
_ROUTER_RUNTIME: Final = "(rx:(worker_threads:16),tx:(worker_threads:4))"
_ENDPOINT = re.compile(
    r"(?P<proto>tcp|udp|tls|quic|ws)/(?P<host>\[[0-9a-fA-F:]+\]|[^/:\[\]]+):(?P<port>\d{1,5})(?:[?#].*)?\Z"
)
_LOCAL = re.compile(r"unixsock-stream/.+\Z")
_RETRY_S: Final = 0.05
_ROUTER_WAIT_S: Final = 10.0
#: Silence after which a connection is closed as dead, and the longest time to open one, s.
LEASE_S: Final = 1.0
_OPEN_S: Final = 1.0
#: Longest time for which a receiver may read nothing, s.
_STUCK_S: Final = 0.3
#: The same by mode, s. A client has a single connection, so nothing else waits behind it. At a router the time must be
#: shorter than the lease: when a subscriber comes or goes, all keep-alive messages wait behind a slow one.
_BLOCKED_S: Final = {"peer": _STUCK_S, "router": _STUCK_S, "client": 5.0}
#: Longest message that is reassembled from fragments, bytes: the largest model plus a margin. With zenoh's default of
#: 1 GiB any sender could make the service allocate that much.
MAX_MESSAGE_BYTES: Final = 72 * 2**20


def check_endpoint(field: str, endpoint: object) -> str:
    """Return ``endpoint`` if zenoh can listen at or connect to it. Raises InputError, naming ``field``, if not."""
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

    Without ``listen`` the session is a client of the first endpoint of ``connect`` that answers, and changes to another
    when that one fails: behind a router clients see each other and peers do not, and a service must see its standby.
    ``zenoh_config`` is zenoh's own JSON5 file, for TLS, passwords and access control; the arguments override it.
    Raises SessionError if an endpoint is not available, such as a port in use, or if no router answers within ten
    seconds (hosts that start together may start in any order).
    """
    if listen:
        return _open("peer", listen, connect, zenoh_config, lease_s)
    return _open_client(connect, _ROUTER_WAIT_S, zenoh_config, lease_s)


def open_router(listen: Sequence[str], connect: Sequence[str] = (), zenoh_config: Path | None = None) -> zenoh.Session:
    """A router: forwards between its clients and to the routers of ``connect``. Raises SessionError."""
    return _open("router", listen, connect, zenoh_config)


def open_client(
    endpoint: str | Sequence[str] = DEFAULT_ENDPOINT, wait_s: float = 0.0, zenoh_config: Path | None = None
) -> zenoh.Session:
    """A client connected to ``endpoint``, retried for ``wait_s`` seconds. Raises SessionError if nothing answers.

    Of several endpoints (a service and its standby) it connects to the first that answers, and changes to another when
    that one fails.
    """
    if isinstance(endpoint, str) or not isinstance(endpoint, Sequence) or not endpoint:
        return _open_client((check_endpoint("endpoint", endpoint),), wait_s, zenoh_config)
    return _open_client(endpoint, wait_s, zenoh_config)


def _open_client(
    connect: Sequence[str], wait_s: float, zenoh_config: Path | None, lease_s: float = LEASE_S
) -> zenoh.Session:
    read_zenoh_config(zenoh_config)  # An unreadable file fails at once, before any wait.
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

    A relative path of the password file is relative to the folder of ``path``, not to that of the process.
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
    # Zenoh reads this once, when it starts its threads, so it must be set before the first session of the process.
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
        # Not faster here, and segments of killed processes stay until /dev/shm is full.
        "transport/shared_memory/enabled": False,
        # After this silence a peer counts as dead. A process that exits is noticed at once by its closed connections.
        "transport/link/tx/lease": round(1e3 * lease_s),
        # A stopped process still accepts connections but does not answer on them.
        "transport/unicast/open_timeout": round(1e3 * _OPEN_S),
        # A receiver that reads nothing for this long is disconnected, so that others need not wait behind it; µs.
        "transport/link/tx/queue/congestion_control/block/wait_before_close": round(1e6 * _BLOCKED_S[mode]),
        "connect/retry": {"period_init_ms": 20, "period_max_ms": 200, "period_increase_factor": 2},
    }
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    try:
        return zenoh.open(config)
    except zenoh.ZError as error:
        raise SessionError(too_few() or _advice(str(error), listen, connect)) from error


def _advice(text: str, listen: Sequence[str], connect: Sequence[str]) -> str:
    if "Address already in use" in text:
        at = ", ".join(listen)
        return f"cannot listen at {at}: the port is in use; stop the program that uses it, or choose another port"
    if "Unable to connect" in text:
        return (
            f"no answer at {', '.join(connect)}, or the certificate or password was refused: start 'dehyst serve' "
            "there, give its endpoint, or see docs/access.md"
        )
    return f"cannot open a zenoh session (listen {list(listen)}, connect {list(connect)}): {_plain(text)}"


def _plain(error: object) -> str:
    """A message of zenoh without its source locations."""
    return re.sub(r"\s+at \S+\.rs:\d+\.?", "", str(error)).strip()
