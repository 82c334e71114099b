"""Refuses endpoints beyond this machine that are not protected by TLS, passwords and access control."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import zenoh

from service.protocol.errors import FieldError
from service.runtime.session import is_loopback, read_zenoh_config

#: Links that are encrypted and know both ends by certificate.
_SECURE_PROTOCOLS: Final = ("tls", "quic")
ADVICE: Final = (
    "make one with 'dehyst access init' and name it as zenoh_config, or say insecure_beyond_loopback = true "
    "(--insecure-beyond-loopback) if all that can reach this address may do everything; see docs/access.md"
)


def check_reach(
    where: str, listen: Sequence[str], connect: Sequence[str], zenoh_config: Path | None, insecure: bool = False
) -> None:
    """Refuse endpoints beyond this machine without mutual TLS, passwords and, to listen, access control.

    Raises InputError naming ``where``, the endpoint and what is missing; SessionError where the file is not zenoh's.
    ``insecure`` : True allows every endpoint.
    """
    if insecure:
        return
    for kind, endpoints in (("listen", listen), ("connect", connect)):
        beyond = [endpoint for endpoint in endpoints if not is_loopback(endpoint)]
        if not beyond:
            continue
        missing = missing_protection(zenoh_config, kind == "listen")
        missing += [
            f"{endpoint} is not one of {', '.join(_SECURE_PROTOCOLS)}"
            for endpoint in beyond
            if endpoint.split("/", 1)[0] not in _SECURE_PROTOCOLS
        ]
        if missing:
            raise FieldError(
                f"{where}: {kind}",
                f"{', '.join(beyond)} with {'; '.join(missing)}",
                "an endpoint of this machine, or zenoh's configuration with TLS, passwords and access control",
                ADVICE,
            )


def missing_protection(zenoh_config: Path | None, listens: bool) -> list[str]:
    """The protections that a zenoh configuration lacks; empty if it has all. Raises SessionError."""
    if zenoh_config is None:
        return ["no zenoh_config"]
    config = read_zenoh_config(zenoh_config)
    tls, auth = _section(config, "transport/link/tls"), _section(config, "transport/auth/usrpwd")
    protocols = _section(config, "transport/link/protocols")
    missing = []
    if not protocols or any(protocol not in _SECURE_PROTOCOLS for protocol in protocols):
        missing.append("transport/link/protocols not limited to tls or quic")
    if tls.get("verify_name_on_connect") is False and not listens:
        missing.append("verify_name_on_connect off")
    if listens:
        if not tls.get("enable_mtls"):
            missing.append("no certificates asked of clients (enable_mtls)")
        if not auth.get("dictionary_file"):
            missing.append("no passwords asked of clients (usrpwd/dictionary_file)")
        if not has_access_control(zenoh_config):
            missing.append("no access control that denies by default")
    elif not auth.get("user"):
        missing.append("no user and password of its own (usrpwd/user)")
    return missing


def has_access_control(zenoh_config: Path | None) -> bool:
    """Whether a configuration enables the access control of zenoh and denies by default."""
    if zenoh_config is None:
        return False
    control = _section(read_zenoh_config(zenoh_config), "access_control")
    return bool(control.get("enabled")) and control.get("default_permission") == "deny"


def _section(config: zenoh.Config, key: str) -> Any:
    try:
        return json.loads(config.get_json(key)) or {}
    except zenoh.ZError:
        return {}
