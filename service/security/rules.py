"""Zenoh's access control for this project: what each role may send to a service or a router (docs/access.md).

Everything that is not allowed here is denied. A rule applies to incoming messages (``ingress``: sent by the other end)
or to outgoing ones (``egress``). Replies and publications may go out to every known role; roles differ in what they may
send.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final

from service.protocol.keys import ROOT

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

_ALL: Final = f"{ROOT}/**"
_QUERIES: Final = ("feedforward", "model", "status")
_OF_STAGE: Final = ("sample", "stage_status")
_OF_CONTROLLER: Final = ("command", "reference")
_OPERATE: Final = "operate"
_LISTEN: Final = ("declare_subscriber", "declare_liveliness_subscriber", "liveliness_query")
_SERVE: Final = ("reply", "declare_queryable", "liveliness_token")


def access_control(users: Mapping[str, str], stages: Mapping[str, str] | None = None) -> dict[str, Any]:
    """The ``access_control`` section of a zenoh configuration.

    Parameters
    ----------
    users : name -> role. A name is that of the certificate and of the password both, so that neither alone is enough;
        of services and routers, which are also connected to, the certificate alone tells.
    stages : name of a user with the role ``stage`` -> the one stage on the wire it may publish for; "*" or none: any.
    """
    stages = stages or {}
    rules: list[dict[str, Any]] = [
        _rule("out", ("put", "reply", "declare_subscriber", "declare_queryable", "liveliness_token"), [_ALL], "egress"),
        _rule("listen", _LISTEN, [_ALL]),
        _rule("query", ("query",), _keys(_QUERIES)),
        _rule("voltages", ("put",), _keys(_OF_CONTROLLER)),
        _rule("operate", ("query",), _keys((_OPERATE,))),
        _rule("serve", (*_SERVE, "query", "put"), [_ALL]),
        _rule("ask", ("query", *_LISTEN), [_ALL], "egress"),
        # Deny rules override allow rules.
        _rule("not_of_service", ("put",), _keys((*_OF_STAGE, *_OF_CONTROLLER)), permission="deny"),
        _rule("not_commanding", ("query",), _keys((_OPERATE,)), permission="deny"),
        _rule("pass_on", ("put", "query", *_SERVE), [_ALL]),
    ]
    allowed: dict[str, tuple[str, ...]] = {
        CLIENT: ("out", "listen", "query"),
        CONTROLLER: ("out", "listen", "query", "voltages"),
        OPERATOR: ("out", "listen", "query", "operate"),
        SERVICE: ("out", "ask", "listen", "serve", "not_of_service", "not_commanding"),
        ROUTER: ("out", "ask", "listen", "pass_on"),
    }
    subjects, policies = [], []
    for name, role in users.items():
        subject: dict[str, Any] = {"id": name, "cert_common_names": [name]}
        # Who opens a connection learns the certificate of who accepts it, but no user name.
        if role not in (SERVICE, ROUTER):
            subject["usernames"] = [name]
        subjects.append(subject)
        ids = allowed.get(role)
        if ids is None:  # a stage: its keys are its own
            rule = f"samples_{name}"
            rules.append(_rule(rule, ("put",), _keys(_OF_STAGE, stages.get(name, "*"))))
            ids = ("out", "listen", "query", rule)
        policies.append({"id": name, "rules": list(ids), "subjects": [name]})
    used = {rule for policy in policies for rule in policy["rules"]}
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": [rule for rule in rules if rule["id"] in used],
        "subjects": subjects,
        "policies": policies,
    }


def _keys(names: Sequence[str], stage: str = "*") -> list[str]:
    return [f"{ROOT}/{stage}/*/{name}" for name in names]


def _rule(
    name: str, messages: Sequence[str], keys: Sequence[str], flow: str = "ingress", permission: str = "allow"
) -> dict[str, Any]:
    return {
        "id": name,
        "messages": list(dict.fromkeys(messages)),
        "flows": [flow],
        "permission": permission,
        "key_exprs": list(keys),
    }
