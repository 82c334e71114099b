"""``dehyst access``: certificates and zenoh configurations for more than one machine.

roles:
{roles}

  dehyst access init --out access --host lab1.example.org --host 192.0.2.10 --stage afm --operator alice \
      --service service --router r1
  dehyst access add --out access --operator bob --client plotter
  dehyst access remove --out access --name bob

Each NAME.json5 goes to the machine of that name and to no other.
'serve', 'router', 'stage', 'query', 'status' and 'view' take such a file by zenoh_config or --zenoh-config. See
docs/access.md.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from dehyst.service.cli.options import add_shared, check_number
from dehyst.service.protocol.errors import FieldError
from dehyst.service.security import access


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the command."""
    roles = "\n".join(f"  {name:<11} {line}" for name, line in access.ROLES.items())
    parser.epilog = str(parser.epilog).format(roles=roles)
    parser.add_argument("what", choices=("init", "add", "remove", "list"), help="make a folder, change it, or show it")
    add_shared(parser, out={"default": Path("access"), "help": "the folder (%(default)s)"})
    parser.add_argument(
        "--host",
        action="append",
        metavar="HOST",
        help="init: name or address under which services and routers are reached; repeatable (localhost, 127.0.0.1)",
    )
    for role in access.ROLES:
        stage = ", or NAME=STAGE to bind it to one stage" if role == access.STAGE else ""
        parser.add_argument(
            f"--{role}", action="append", default=[], metavar="NAME", help=f"{role} of this name{stage}"
        )
    parser.add_argument("--name", action="append", default=[], metavar="NAME", help="remove: whose access ends")
    parser.add_argument("--days", type=int, default=825, metavar="DAYS", help="validity of certificates, days (825)")
    add_shared(parser, json={"help": "print JSON"})


def run(args: argparse.Namespace) -> int:
    """Write or list the files. Returns 0."""
    check_number("--days", args.days, "days", low=1, high=36_500)
    users, stages = _named(args)
    if args.what == "init":
        if not users:
            users = {role: role for role in access.ROLES}
        elif not {access.SERVICE, access.ROUTER} & set(users.values()):
            users = {access.SERVICE: access.SERVICE, **users}
        hosts = tuple(args.host or access.DEFAULT_HOSTS)
        written = access.create(args.out, access.Plan(users, hosts, stages), args.days)
    elif args.what == "add":
        if not users:
            raise FieldError("add", "nobody", "one or more of --client NAME, --operator NAME, ...")
        written = access.add(args.out, users, stages, args.days)
    elif args.what == "remove":
        if not args.name:
            raise FieldError("--name", "nothing", "who is to be shut out")
        written = access.remove(args.out, args.name)
    else:
        written = []
    plan = access.read_plan(args.out)
    if args.json:
        print(json.dumps({"schema": 1, "users": dict(plan.users), "written": [str(path) for path in written]}))
        return 0
    for name, role in plan.users.items():
        bound = f" (stage {plan.stages[name]})" if name in plan.stages else ""
        print(f"{name:<20} {role}{bound}: {access.ROLES[role]}")
    for path in written:
        print(f"wrote {path}")
    if args.what in ("add", "remove"):
        print("copy the new files to services and routers, and restart them")
    return 0


def _named(args: argparse.Namespace) -> tuple[dict[str, str], dict[str, str]]:
    users: dict[str, str] = {}
    stages: dict[str, str] = {}
    for role in access.ROLES:
        for given in getattr(args, role):
            name, _, stage = given.partition("=")
            if name in users:
                raise FieldError(f"--{role}", name, "a different name for each")
            users[name] = role
            if stage:
                if role != access.STAGE:
                    raise FieldError(f"--{role}", given, "a name")
                stages[name] = stage
    return users, stages
