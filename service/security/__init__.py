"""Access to a service: zenoh's TLS, passwords and access control.

`create`, `add` and `remove` make the access files of a `Plan`, `access_control` the rules of the `ROLES`. `check_reach`
refuses to start a service that others could reach without protection. `count_refusals` counts what zenoh refuses. An
`Authenticator` signs what is said on the wire and checks it. The names are loaded on first use.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from adaptive.lazy_names import lazy_names

if TYPE_CHECKING:
    from service.security.access import ROLES as ROLES
    from service.security.access import Plan as Plan
    from service.security.access import access_control as access_control
    from service.security.access import add as add
    from service.security.access import create as create
    from service.security.access import read_plan as read_plan
    from service.security.access import remove as remove
    from service.security.authenticator import Authenticator as Authenticator
    from service.security.authenticator import own_authenticator as own_authenticator
    from service.security.check import check_reach as check_reach
    from service.security.check import has_access_control as has_access_control
    from service.security.refusals import Refusals as Refusals
    from service.security.refusals import count_refusals as count_refusals

__getattr__ = lazy_names(__name__)
