"""Access of an installation on several hosts (docs/access.md).

Rules of the roles; the files that `create` makes: certificates and zenoh configurations; and `check_reach`, which
refuses endpoints beyond this machine whose configuration lacks what these have.
"""

from __future__ import annotations

import base64
import ipaddress
import json
import secrets
import shutil
import subprocess
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Final

import zenoh

from dehyst.service.protocol.errors import FieldError, ServiceError
from dehyst.service.protocol.keys import ROOT, check_name
from dehyst.service.runtime.session import is_loopback, read_zenoh_config
from dehyst.service.storage.output import atomic_write

# --- Zenoh's access control for this project: what each role may send to a service or a router (docs/access.md).
#
# Everything that is not allowed here is denied. A rule applies to incoming messages (``ingress``: sent by the other
# end) or to outgoing ones (``egress``). Replies and publications may go out to every known role; roles differ in what
# they may send.

#: Permissions of each role. The first four are programs and people; services and routers connect them.
CLIENT: Final = "client"
CONTROLLER: Final = "controller"
STAGE: Final = "stage"
OPERATOR: Final = "operator"
SERVICE: Final = "service"
ROUTER: Final = "router"
ROLES: Final = {
    CLIENT: "may query (feedforward, model, status) and subscribe",
    CONTROLLER: "the same, and may publish voltages and references",
    STAGE: "may publish samples, and hears voltages",
    OPERATOR: "may query, subscribe and command (freeze, roll back, ...)",
    SERVICE: "answers and publishes all but samples, voltages and references; commands nobody",
    ROUTER: "passes on everything",
}

_SAMPLES: Final = ("*/*/sample", "*/*/stage_status")
_VOLTAGES: Final = ("*/*/command", "*/*/reference")
_LISTEN: Final = ("declare_subscriber", "declare_liveliness_subscriber", "liveliness_query")
_SERVE: Final = ("reply", "declare_queryable", "liveliness_token")
#: Rule -> messages, keys below the root, direction, and permission. Rules that deny override those that allow.
_RULES: Final[dict[str, tuple[tuple[str, ...], tuple[str, ...], str, str]]] = {
    "out": (("put", "declare_subscriber", *_SERVE), ("**",), "egress", "allow"),
    "ask": (("query", *_LISTEN), ("**",), "egress", "allow"),
    "listen": (_LISTEN, ("**",), "ingress", "allow"),
    "query": (("query",), ("*/*/feedforward", "*/*/model", "*/*/status"), "ingress", "allow"),
    "voltages": (("put",), _VOLTAGES, "ingress", "allow"),
    "own": (("liveliness_token",), ("*/*/owner/**",), "ingress", "allow"),
    "samples": (("put",), _SAMPLES, "ingress", "allow"),
    "operate": (("query",), ("*/*/operate",), "ingress", "allow"),
    "all": (("put", "query", *_SERVE), ("**",), "ingress", "allow"),
    "no_input": (("put",), (*_SAMPLES, *_VOLTAGES), "ingress", "deny"),
    "no_command": (("query",), ("*/*/operate",), "ingress", "deny"),
}
_ALLOWED: Final = {
    CLIENT: ("out", "listen", "query"),
    CONTROLLER: ("out", "listen", "query", "voltages", "own"),
    STAGE: ("out", "listen", "query", "samples"),
    OPERATOR: ("out", "listen", "query", "operate"),
    SERVICE: ("out", "ask", "listen", "all", "no_input", "no_command"),
    ROUTER: ("out", "ask", "listen", "all"),
}


def access_control(users: Mapping[str, str], stages: Mapping[str, str] | None = None) -> dict[str, Any]:
    """The ``access_control`` section of a zenoh configuration.

    Parameters
    ----------
    users : name -> role. The name is the common name of the certificate.
    stages : name of a user with the role ``stage`` -> the one stage on the wire it may publish for; "*" or none: any.
    """
    rules, policies = dict[str, dict[str, Any]](), []
    for name, role in users.items():
        of = (stages or {}).get(name, "*")
        ids = [f"{rule}_{name}" if rule == "samples" else rule for rule in _ALLOWED[role]]
        policies.append({"id": name, "rules": ids, "subjects": [name]})
        for id_, rule in zip(ids, _ALLOWED[role], strict=True):
            messages, keys, flow, permission = _RULES[rule]
            # The keys of a stage are its own.
            at = [f"{ROOT}/{key.replace('*', of, 1) if rule == 'samples' else key}" for key in keys]
            about = {"messages": list(messages), "flows": [flow], "permission": permission, "key_exprs": at}
            rules[id_] = {"id": id_, **about}
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": list(rules.values()),
        "subjects": [{"id": name, "cert_common_names": [name]} for name in users],
        "policies": policies,
    }


# --- Creates the access files of an installation on several hosts: certificates and zenoh configurations.
#
# ::
#
#     DIR/access.json        users and their roles; the other files are made from it
#     DIR/ca/                key and certificate of the certificate authority; never copy the key to another machine
#     DIR/NAME.json5         zenoh's configuration of NAME with its certificate and key; for the machine of NAME only
#
# Only the owner can read the files. The ``openssl`` command makes the certificates.

MANIFEST: Final = "access.json"
DEFAULT_HOSTS: Final = ("localhost", "127.0.0.1")
_SCHEMA: Final = 1
_CA_DAYS: Final = 3650
_NEW_KEY: Final = ("-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-nodes")


@dataclass(frozen=True, slots=True)
class Plan:
    """The users of an installation.

    Attributes
    ----------
    users : role by user name. hosts : names and addresses of services and routers.
    stages : by name of a user with the role stage, the only stage that it may publish for; ``*`` for all.
    """

    users: Mapping[str, str]
    hosts: tuple[str, ...] = DEFAULT_HOSTS
    stages: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name, role in self.users.items():
            check_name("user", name)
            if role not in ROLES:
                raise FieldError(f"role of {name}", repr(role), f"one of {', '.join(ROLES)}")
        for name, stage in self.stages.items():
            if self.users.get(name) != STAGE:
                raise FieldError("stages", name, "a user with the role stage")
            if stage != "*":
                check_name(f"stage of {name}", stage)
        if not self.hosts:
            raise FieldError("hosts", "none", "the host names or addresses of services and routers")


def create(folder: Path, plan: Plan, days: int = 825) -> list[Path]:
    """Create all access files in ``folder``; returns the files for the machines.

    ``days`` is the validity of the certificates. Raises InputError if ``folder`` already holds access files,
    ServiceError if openssl is missing or fails.
    """
    if (folder / MANIFEST).exists():
        raise FieldError(str(folder), "an access folder", "a new one", "use 'dehyst access add' to add users")
    ca = folder / "ca"
    ca.mkdir(parents=True, exist_ok=True, mode=0o700)
    folder.chmod(0o700)
    _openssl(
        "req", "-x509", *_NEW_KEY, "-days", str(_CA_DAYS), "-subj", "/CN=dehyst authority",
        "-addext", "basicConstraints=critical,CA:TRUE,pathlen:0", "-addext", "keyUsage=critical,keyCertSign,cRLSign",
        "-keyout", str(ca / "ca.key"), "-out", str(ca / "ca.pem"),
    )  # fmt: skip
    (ca / "ca.key").chmod(0o600)
    return _write_all(folder, plan, list(plan.users), days)


def add(folder: Path, users: Mapping[str, str], stages: Mapping[str, str], days: int = 825) -> list[Path]:
    """Add ``users`` (name -> role); returns the new and changed files. Raises InputError if a name is taken."""
    plan = read_plan(folder)
    known = [name for name in users if name in plan.users]
    if known:
        raise FieldError("user", ", ".join(known), "a name that is not taken", "remove it first for a new certificate")
    bigger = Plan({**plan.users, **users}, plan.hosts, {**plan.stages, **stages})
    return _write_all(folder, bigger, list(users), days)


def remove(folder: Path, names: Sequence[str]) -> list[Path]:
    """Remove ``names`` from access control; returns the changed files. Raises InputError.

    Services and routers read their files at the start: restart them with the new files to exclude the users.
    """
    plan = read_plan(folder)
    for name in names:
        if name not in plan.users:
            raise FieldError("user", name, f"one of {', '.join(plan.users)}")
    smaller = Plan(
        {name: role for name, role in plan.users.items() if name not in names},
        plan.hosts,
        {name: stage for name, stage in plan.stages.items() if name not in names},
    )
    for name in names:
        (folder / f"{name}.json5").unlink(missing_ok=True)
    return _write_all(folder, smaller, [], 0)


def read_plan(folder: Path) -> Plan:
    """The plan of an access folder. Raises InputError if ``folder`` is not one."""
    try:
        data = json.loads((folder / MANIFEST).read_text(encoding="utf-8"))
        if data["schema"] != _SCHEMA:
            raise FieldError(f"{folder / MANIFEST}: schema", data["schema"], str(_SCHEMA))
        return Plan(dict(data["users"]), tuple(data["hosts"]), dict(data["stages"]))
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise FieldError(str(folder), str(error), "a folder made by 'dehyst access init'") from error


def _write_all(folder: Path, plan: Plan, new: Sequence[str], days: int) -> list[Path]:
    """Write certificates for the users ``new``, and every file that depends on the list of users."""
    control = access_control(plan.users, plan.stages)
    changed = []
    for name, role in plan.users.items():
        path = folder / f"{name}.json5"
        listens = role in (SERVICE, ROUTER)
        if name in new:
            config = _configuration(folder / "ca", name, plan.hosts, days, listens)
        elif listens:
            config = json.loads(path.read_text(encoding="utf-8").split("\n", 1)[1])
        else:
            continue
        if listens:
            config["access_control"] = control
        _write(path, f"// zenoh configuration of {name}: {ROLES[role]}; holds its key, keep it secret\n{_json(config)}")
        changed.append(path)
    _write(folder / MANIFEST, _json({"schema": _SCHEMA, **asdict(plan)}))
    return changed


def _configuration(ca: Path, name: str, hosts: Sequence[str], days: int, listens: bool) -> dict[str, Any]:
    """Zenoh's settings of one user, with a new key and a certificate with the common name ``name`` in them.

    ``listens`` : valid for both ends of a connection, with the names in ``hosts``. Else for the end that connects only,
    so that nobody takes a client for the service.
    """
    named = ",".join(f"{'IP' if _is_address(host) else 'DNS'}:{host}" for host in hosts)
    usage = f"serverAuth,clientAuth\nsubjectAltName={named}" if listens else "clientAuth"
    extensions = f"basicConstraints=critical,CA:FALSE\nkeyUsage=critical,digitalSignature\nextendedKeyUsage={usage}\n"
    with tempfile.TemporaryDirectory() as scratch:
        at = Path(scratch)
        (at / "extensions").write_text(extensions, encoding="utf-8")
        _openssl("req", *_NEW_KEY, "-subj", f"/CN={name}", "-keyout", str(at / "key"), "-out", str(at / "request"))
        _openssl(
            "x509", "-req", "-in", str(at / "request"), "-CA", str(ca / "ca.pem"), "-CAkey", str(ca / "ca.key"),
            "-set_serial", f"0x{secrets.token_hex(16)}", "-days", str(days), "-extfile", str(at / "extensions"),
            "-out", str(at / "certificate"),
        )  # fmt: skip
        pems = (path.read_bytes() for path in (ca / "ca.pem", at / "certificate", at / "key"))
        root, certificate, key = (base64.b64encode(pem).decode() for pem in pems)
    tls: dict[str, Any] = {
        "root_ca_certificate_base64": root,
        "connect_certificate_base64": certificate,
        "connect_private_key_base64": key,
        "enable_mtls": True,
        "verify_name_on_connect": True,
        "close_link_on_expiration": True,
    }
    if listens:
        tls |= {"listen_certificate_base64": certificate, "listen_private_key_base64": key}
    return {"transport": {"link": {"protocols": ["tls"], "tls": tls}}}


def _is_address(host: str) -> bool:
    try:
        ipaddress.ip_address(host)
    except ValueError:
        if not host or any(mark in host for mark in ",:/\n "):
            raise FieldError("host", repr(host), "a host name or an address, without port") from None
        return False
    return True


def _openssl(*arguments: str) -> None:
    command = shutil.which("openssl")
    if command is None:
        raise ServiceError("openssl is not installed: install it (the command line tool), or make certificates by hand")
    done = subprocess.run([command, *arguments], capture_output=True, text=True, check=False)
    if done.returncode:
        raise ServiceError(f"openssl {arguments[0]} failed: {done.stderr.strip()[-300:]}")


def _json(data: Any) -> str:
    return json.dumps(data, indent=2) + "\n"


def _write(path: Path, text: str) -> None:
    """Write atomically; only the owner can read the file at any time."""
    with atomic_write(path, mode=0o600) as file:
        file.write(text.encode())


# --- What a configuration must have to be reached from beyond this machine.

#: Links that are encrypted and know both ends by certificate.
_SECURE_PROTOCOLS: Final = ("tls", "quic")
ADVICE: Final = (
    "make one with 'dehyst access init' and name it as zenoh_config, or say insecure_beyond_loopback = true "
    "(--insecure-beyond-loopback) if all that can reach this address may do everything; see docs/access.md"
)


def check_reach(
    where: str, listen: Sequence[str], connect: Sequence[str], zenoh_config: Path | None, insecure: bool = False
) -> None:
    """Refuse endpoints beyond this machine without mutual TLS and, to listen, access control.

    Raises InputError naming ``where``, the endpoint and what is missing; SessionError where the file is not zenoh's.
    ``insecure`` : True allows every endpoint.
    """
    for kind, endpoints in (("listen", listen), ("connect", connect)):
        beyond = [endpoint for endpoint in endpoints if not insecure and not is_loopback(endpoint)]
        missing = missing_protection(zenoh_config, kind == "listen") if beyond else []
        plain = (endpoint for endpoint in beyond if endpoint.split("/", 1)[0] not in _SECURE_PROTOCOLS)
        missing += [f"{endpoint} is not one of {', '.join(_SECURE_PROTOCOLS)}" for endpoint in plain]
        if missing:
            got = f"{', '.join(beyond)} with {'; '.join(missing)}"
            expected = "an endpoint of this machine, or zenoh's configuration with TLS and access control"
            raise FieldError(f"{where}: {kind}", got, expected, ADVICE)


def missing_protection(zenoh_config: Path | None, listens: bool) -> list[str]:
    """The protections that a zenoh configuration lacks; empty if it has all. Raises SessionError."""
    if zenoh_config is None:
        return ["no zenoh_config"]
    config = read_zenoh_config(zenoh_config)
    tls, protocols = _section(config, "transport/link/tls"), _section(config, "transport/link/protocols")
    plain = not protocols or not set(protocols) <= {*_SECURE_PROTOCOLS}
    lacks = {
        "transport/link/protocols not limited to tls or quic": plain,
        "verify_name_on_connect off": not listens and tls.get("verify_name_on_connect") is False,
        "no certificates of both ends (enable_mtls)": not tls.get("enable_mtls"),
        "no access control that denies by default": listens and not has_access_control(zenoh_config),
    }
    return [what for what, is_missing in lacks.items() if is_missing]


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
