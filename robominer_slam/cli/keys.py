"""`robominer-slam keys`: certificates for robots, operators and viewers, and who may do what."""

from __future__ import annotations

import json
import shlex
from datetime import UTC, datetime
from pathlib import Path

import click
from rich.console import Console
from rich.table import Table

from robominer_slam.security.access_list import MEANING, ROLES, Holder, Role
from robominer_slam.security.authority import DEFAULT_DAYS, Authority

#: Where an operator's own machine keeps the authority; not on the robot.
DEFAULT_FOLDER = Path(click.get_app_dir("robominer-slam")) / "keys"
COLOURS = {"valid": "green", "expires soon": "yellow", "expired": "red", "revoked": "magenta"}
DAYS = click.IntRange(1, 3650)

folder_option = click.option(
    "--folder",
    type=click.Path(file_okay=False, path_type=Path),
    default=DEFAULT_FOLDER,
    show_default="robominer-slam/keys in your configuration folder",
    envvar="ROBOMINER_SLAM_KEYS",
    help="The authority's folder; keep it off the robot.",
)


@click.group(epilog="Example: robominer-slam keys init && robominer-slam keys issue alice --role operator")
def keys() -> None:
    """Certificates and access control, for robots that are reached over a network (docs/security.md)."""


@keys.command(epilog="Example: robominer-slam keys init --folder keys")
@folder_option
@click.option("--renew", is_flag=True, help="A new authority in place of the old one, which is put aside.")
@click.option(
    "--days", type=DAYS, default=DEFAULT_DAYS, show_default=True, help="Validity of certificates, with --renew."
)
def init(folder: Path, renew: bool, days: int) -> None:
    """Make the certificate authority.

    With --renew everybody who was not revoked gets a new certificate of the new authority; whoever has only an old one,
    also a stolen one, is refused as soon as the robots have their new bundles.
    """
    if not renew:
        Authority.create(folder)
        click.echo(f"authority in {folder}: keep it secret, and a copy of it safe")
        return
    for holder in Authority(folder).renew(days):
        click.echo(f"{holder.name} ({holder.role}): new bundle in {Authority(folder).bundle(holder.name)}")
    click.echo(f"copy every bundle to its machine; the old authority is in {folder / 'retired'}")


@keys.command(epilog="Example: robominer-slam keys issue rm3 --role robot --host robot.local --host 192.168.7.2")
@click.argument("name")
@click.option(
    "--role", type=click.Choice(ROLES), required=True, help="; ".join(f"{r}: {m}" for r, m in MEANING.items())
)
@click.option("--days", type=DAYS, default=DEFAULT_DAYS, show_default=True, help="How long it is valid.")
@click.option("--host", "hosts", multiple=True, help="Host name or address under which a robot is called; repeatable.")
@click.option("--replace", is_flag=True, help="A new key and certificate for one who has one.")
@folder_option
def issue(name: str, role: Role, days: int, hosts: tuple[str, ...], replace: bool, folder: Path) -> None:
    """Make a certificate for NAME, and a bundle to be copied to its machine."""
    authority = Authority(folder)
    holder = authority.issue(name, role, days, hosts, replace=replace)
    bundle = authority.bundle(name)
    click.echo(f"{name} ({role}) until {_minutes(holder.expires)}: copy {bundle} to its machine, and delete it here")
    if role == "robot":
        click.echo("in the robot's configuration, [zenoh] credentials names the folder; start the daemon anew")
    else:
        _say_to_copy_the_list(authority)


@keys.command("list", epilog="Example: robominer-slam keys list --json")
@folder_option
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
def list_(folder: Path, as_json: bool) -> None:
    """Who has a certificate, in which role, until when."""
    now = datetime.now(UTC)
    holders = sorted(Authority(folder).access_list.holders.values(), key=lambda holder: (holder.role, holder.name))
    if as_json:
        click.echo(json.dumps([_described(holder, now) for holder in holders]))
        return
    table = Table()
    for column in ("name", "role", "state", "expires", "hosts"):
        table.add_column(column)
    for holder in holders:
        state = holder.state(now)
        table.add_row(
            holder.name, holder.role, f"[{COLOURS[state]}]{state}[/]", _minutes(holder.expires), " ".join(holder.hosts)
        )
    Console().print(table)


@keys.command(epilog="Example: robominer-slam keys revoke mallory")
@click.argument("name")
@folder_option
def revoke(name: str, folder: Path) -> None:
    """Take NAME off the access list.

    Zenoh has no revocation list: until its certificate expires, NAME can still connect, but is shown nothing and obeyed
    in nothing. For a robot's stolen key, renew the authority: keys init --renew.
    """
    authority = Authority(folder)
    holder = authority.revoke(name)
    click.echo(f"{name} ({holder.role}) is off the list")
    _say_to_copy_the_list(authority)
    if holder.role == "robot":
        click.echo(f"operators cannot tell that {name} is revoked: if its key was stolen, keys init --renew")


def _say_to_copy_the_list(authority: Authority) -> None:
    for robot in authority.access_list.names(["robot"]):
        path = shlex.quote(str(authority.folder / "access.json"))
        click.echo(f"copy {path} into the credentials folder of {robot}, and start its daemon anew")


def _minutes(time: str) -> str:
    return f"{datetime.fromisoformat(time):%Y-%m-%d %H:%M} UTC"


def _described(holder: Holder, now: datetime) -> dict[str, object]:
    return {
        "name": holder.name,
        "role": holder.role,
        "state": holder.state(now),
        "issued": holder.issued,
        "expires": holder.expires,
        "hosts": list(holder.hosts),
        "revoked": holder.revoked or None,
        "serial": holder.serial,
    }
