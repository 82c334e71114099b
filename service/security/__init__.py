"""Access to a service: zenoh's TLS, passwords and access control.

`create`, `add` and `remove` make the access files of a `Plan`, `access_control` the rules of the `ROLES`. `check_reach`
refuses to start a service that others could reach without protection. `count_refusals` counts what zenoh refuses. The
names are loaded on first use.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from adaptive.lazy_names import lazy_names

if TYPE_CHECKING:
    from service.security.access import ROLES, Plan, access_control, add, create, read_plan, remove
    from service.security.check import check_reach, has_access_control
    from service.security.refusals import Refusals, count_refusals

_MODULES = {
    "ROLES": "access",
    "Plan": "access",
    "Refusals": "refusals",
    "access_control": "access",
    "add": "access",
    "check_reach": "check",
    "count_refusals": "refusals",
    "PeerSecret": "peers",
    "create": "access",
    "has_access_control": "check",
    "read_plan": "access",
    "read_secret": "peers",
    "remove": "access",
}
__all__ = [
    "ROLES",
    "PeerSecret",
    "Plan",
    "Refusals",
    "access_control",
    "add",
    "check_reach",
    "count_refusals",
    "create",
    "has_access_control",
    "read_plan",
    "read_secret",
    "remove",
]

__getattr__ = lazy_names(__name__, _MODULES)
