"""``dehyst metrics``: the status of all axes for Prometheus.

Grafana: import deploy/grafana-dashboard.json. Names and alarms: docs/monitoring.md.

  dehyst metrics --port 9464
  curl http://127.0.0.1:9464/metrics
"""

from __future__ import annotations

import argparse

from dehyst.service.cli import options


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the command, with units in the help."""
    add = parser.add_argument
    options.add_connection(parser)
    options.add_selection(parser)
    add("--port", type=int, default=9464, metavar="N", help="port of the page, 0 for a free one (%(default)s)")
    add("--address", default="127.0.0.1", metavar="IP", help="address to listen at (%(default)s, this machine only)")
    add("--once", action="store_true", help="print the page once, and exit")
    options.add_shared(parser, "duration")


def run(args: argparse.Namespace) -> int:
    """Serve the page until interrupted. Returns 0. Raises InputError where the package or the port is missing."""
    options.check_selection(args)
    options.check_number("--port", args.port, low=0, high=65_535)
    from dehyst.service.operating.metrics import page, serve_page
    from dehyst.service.operating.remote import statuses
    from dehyst.service.runtime.session import open_client
    from dehyst.service.runtime.stopping import StopSignal

    stop = StopSignal()
    with open_client(args.endpoint, args.wait, args.zenoh_config) as session:

        def collect() -> bytes:
            return page(statuses(session, args.stage, args.axis, args.timeout))

        if args.once:
            stop.wait(0.5)  # a new session does not know the services at once
            print(collect().decode(), end="")
            return 0
        with serve_page(args.address, args.port, collect) as port:
            print(f"metrics at http://{args.address}:{port}/metrics", flush=True)
            print(f"stopped: {stop.wait(args.duration)}", flush=True)
    return 0
