"""``dehyst router``: forward messages between stages, services and clients on several hosts (docs/scale.md).

Several hosts: docs/scale.md.

  dehyst router --listen tcp/127.0.0.1:7450
  dehyst router --listen tls/0.0.0.0:7447 --zenoh-config access/r1.json5    # see 'dehyst access --help'
"""

from __future__ import annotations

import argparse
import json

from dehyst.service.cli.options import add_shared


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the command."""
    add = parser.add_argument
    add("--listen", action="append", metavar="ENDPOINT", help="listen here; repeatable (tcp/127.0.0.1:7447)")
    add("--connect", action="append", default=[], metavar="ENDPOINT", help="another router; repeatable")
    add_shared(parser, "insecure-beyond-loopback", "duration")
    add_shared(parser, zenoh_config={"help": "zenoh's own configuration: TLS, access control"})
    add_shared(parser, json={"help": "print JSON"})


def run(args: argparse.Namespace) -> int:
    """Route until interrupted. Returns 0. Raises DehystError where an endpoint is in use or not allowed."""
    from dehyst.service.runtime.session import DEFAULT_ENDPOINT, check_endpoint, open_router
    from dehyst.service.runtime.stopping import StopSignal
    from dehyst.service.security.access import check_reach, has_access_control
    from dehyst.service.security.refusals import count_refusals, refusal_counters

    listen = [check_endpoint("--listen", endpoint) for endpoint in args.listen or [DEFAULT_ENDPOINT]]
    connect = [check_endpoint("--connect", endpoint) for endpoint in args.connect]
    check_reach("router", listen, connect, args.zenoh_config, args.insecure_beyond_loopback)
    stop = StopSignal()
    if has_access_control(args.zenoh_config):
        count_refusals()
    with open_router(listen, connect, args.zenoh_config):
        ready = {"ready": True, "listen": listen, "connect": connect}
        print(json.dumps(ready) if args.json else f"ready: router at {', '.join(listen)}", flush=True)
        reason = stop.wait(args.duration)
    refused = refusal_counters()
    if args.json:
        print(json.dumps({"stopped": reason, "refused": refused}), flush=True)
    else:
        counted = "" if refused is None else "; refused " + ", ".join(f"{n} {name}" for name, n in refused.items())
        print(f"stopped: {reason}{counted}", flush=True)
    return 0
