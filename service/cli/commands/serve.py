"""``dehyst serve``: the serving process.

All keys of the configuration: docs/configuration.md.

  dehyst serve --example > serve.toml    # then set model file and limits
  dehyst serve --config serve.toml
  dehyst serve --config serve.toml --standby

'dehyst stage --examples DIR' makes a folder with the files that these examples name.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from dehyst.service.cli.options import add_shared
from dehyst.service.config.settings import ServeConfig, read_config
from dehyst.service.protocol.errors import FieldError
from dehyst.service.runtime.descriptors import need_descriptors
from dehyst.service.runtime.memory import starting
from dehyst.service.runtime.session import check_endpoint, is_loopback
from dehyst.service.security.access import has_access_control
from dehyst.service.security.refusals import count_refusals

if TYPE_CHECKING:
    from dehyst.service.server.process import Service


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the command, with units in the help."""
    add = parser.add_argument
    add("--config", type=Path, metavar="FILE", help="TOML file: stage, axes, model files, limits in V, V/s and µm")
    add("--example", action="store_true", help="print an example configuration, with every key and default, and exit")
    add("--listen", action="append", metavar="ENDPOINT", help="listen here instead, on this machine only; repeatable")
    add(
        "--standby", action="store_true", help="run as hot standby: learn the same, and take over when the service dies"
    )
    add("--open", action="store_true", help="without a key: nothing is signed, and everybody on the wire is believed")
    add_shared(parser, "insecure-beyond-loopback", "duration")
    add_shared(parser, quiet={"help": "print no line a minute"})
    add_shared(parser, json={"help": "print the ready line and the last status as JSON"})


def run(args: argparse.Namespace) -> int:
    """Serve until interrupted. Returns 0. Raises DehystError where configuration, model file or port is wrong."""
    if args.example:
        from dehyst.service.config.reference import example

        print(example(), end="")
        return 0
    if args.config is None:
        raise FieldError("--config", "nothing", "a TOML file", "'dehyst serve --example' prints an example")
    with starting() as started:
        config = _with_listen(read_config(args.config, args.insecure_beyond_loopback), args.listen, args.standby)
        config = replace(config, open=config.open or args.open)
        need_descriptors(len(config.axes) or 1)
        if config.fleet is not None:
            return _run_fleet(config, args, started)
        from dehyst.service.runtime.stopping import StopSignal
        from dehyst.service.server.process import Service, tune_process

        tune_process()
        stop = StopSignal()
        if has_access_control(config.zenoh_config):
            count_refusals()
        with Service(config, standby=args.standby, stopped=lambda: bool(stop.reason)) as service:
            started()
            _print_ready(service.ready(), args.json)
            for _ in stop.every(SUMMARY_S, args.duration):
                if not (args.quiet or args.json):
                    print(summary(service), flush=True)
            reason = stop.wait(0.0)
            statuses = {axis.keys.axis: axis.status() for axis in service.axes}
    if args.json:
        print(json.dumps({"stopped": reason, "axes": statuses}, default=str), flush=True)
    else:
        for name, status in statuses.items():
            samples, queries = status["samples"], status["queries"]
            print(
                f"{name}: {samples['received']} samples received, {samples['learnt']} learnt, {samples['lost']} lost "
                f"in transit, {samples['thinned']} left out, {samples['dropped']} dropped; {queries['count']} queries, "
                f"{queries['errors']} refused"
            )
        print(f"stopped: {reason}", flush=True)
    return 0


def _run_fleet(config: ServeConfig, args: argparse.Namespace, started: Callable[[], None]) -> int:
    """Serve a fleet until interrupted. Only here a fleet is imported."""
    if args.standby:
        raise FieldError("--standby", "a fleet", "[[axis]] tables", "a fleet has no standby")
    from dehyst.service.fleet.serving import FleetService
    from dehyst.service.runtime.stopping import StopSignal
    from dehyst.service.server.process import tune_process

    tune_process()
    stop = StopSignal()
    with FleetService(config) as service:
        started()
        _print_ready(service.ready(), args.json)
        reason = stop.wait(args.duration)
    status = service.status()
    if args.json:
        print(json.dumps({"stopped": reason, "fleet": status}, default=str), flush=True)
    else:
        samples = status["samples"]
        print(f"{samples['received']} samples of all axes received, {samples['dropped']} dropped; stopped: {reason}")
    return 0


#: Period of the line that says how it goes, s.
SUMMARY_S: Final = 60.0


def summary(service: Service) -> str:
    """One line on all axes: state, rates, errors."""
    parts = []
    for axis in service.axes:
        status = axis.status()
        samples, quality = status["samples"], status["quality"]
        error = quality.get("recent_rms_error_pct")
        words = [
            f"{axis.keys.axis}: {status['state']}" + (f" ({status['state_reason']})" if status["state_reason"] else ""),
            f"{status['rate_per_s'] or 0:.0f} samples/s",
            f"{samples['learnt']} learnt",
        ]
        words += [f"{samples[name]} {name}" for name in ("thinned", "dropped", "lost") if samples[name]]
        words += [f"error {error:.3g} %"] if isinstance(error, float) else []
        words.append(f"{status['queries']['count']} queries")
        parts.append(", ".join(words))
    return f"{time.strftime('%H:%M:%S')} {'; '.join(parts)}"


def _print_ready(ready: dict[str, Any], as_json: bool) -> None:
    if as_json:
        print(json.dumps(ready), flush=True)
        return
    where = ", ".join((*ready["listen"], *ready["connect"]))
    axes = "; ".join(f"{name}: {', '.join(models)}" for name, models in ready["axes"].items())
    role = ready["role"] + ("" if ready["synced"] else " WITHOUT the model of the primary")
    signed = f"signed by the key in {ready['key_file']}" if ready["key_file"] else "NOT signed"
    print(f"ready as {role} at {where}, keys {ready['key']}/..., models {axes}; {signed}", flush=True)


def _with_listen(config: ServeConfig, listen: list[str] | None, standby: bool) -> ServeConfig:
    if not listen:
        return config
    for endpoint in listen:
        if not is_loopback(check_endpoint("--listen", endpoint)):
            raise FieldError("--listen", endpoint, "an endpoint of this machine", "put others into the configuration")
    return replace(config, standby_listen=tuple(listen)) if standby else replace(config, listen=tuple(listen))
