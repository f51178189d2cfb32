"""The manual page, from the program's own help: `python packaging/man_page.py > robominer-slam.1`.

One page with all subcommands; click-man knows only those that a group holds from the start, and ours are loaded late.
"""

from __future__ import annotations

import os
import time
from collections.abc import Iterator

import click

from robominer_slam import __version__
from robominer_slam.cli.main import cli

NAME = "robominer-slam"
ENDING = r"""
.SH FILES
.TP
.I /etc/robominer-slam/config.toml
The daemon's configuration. All parameters with unit, range and reason: robominer-slam run --config FILE --print-config
.TP
.I /var/lib/robominer-slam/map.db
The maps.
.TP
.I /dev/robominer/
Names of the robot's devices that stay, by serial number and by socket.
.SH EXIT STATUS
0: done. 1: not content, or failed. 2: a mistake in a command, a configuration or a file, said in one line.
.SH SEE ALSO
.BR systemctl (1),
.BR journalctl (1);
/usr/share/doc/robominer-slam
"""


def escaped(text: str) -> str:
    """Text as roff takes it literally."""
    lines = " ".join(text.replace("\b", "").split()).replace("\\", r"\e").replace("-", r"\-")
    return rf"\&{lines}" if lines[:1] in (".", "'") else lines


def commands(group: click.Group, context: click.Context) -> Iterator[tuple[str, click.Command, click.Context]]:
    """Every command that does something, with its full name, in order."""
    for name in group.list_commands(context):
        command = group.get_command(context, name)
        if command is None or command.hidden:
            continue
        inner = click.Context(command, info_name=name, parent=context)
        if isinstance(command, click.Group):
            yield from commands(command, inner)
        else:
            yield inner.command_path, command, inner


def options(command: click.Command, context: click.Context) -> Iterator[str]:
    """A command's options, each as an item."""
    for parameter in command.get_params(context):
        record = parameter.get_help_record(context)
        if record is not None and record[1] and "--help" not in record[0]:
            names, text = record
            yield f".TP\n.B {escaped(names)}\n{escaped(text)}"


def page() -> str:
    """The whole page."""
    date = time.strftime("%Y-%m-%d", time.gmtime(float(os.environ.get("SOURCE_DATE_EPOCH", time.time()))))
    context = click.Context(cli, info_name=NAME, help_option_names=["-h", "--help"])
    lines = [
        f'.TH ROBOMINER\\-SLAM 1 "{date}" "{__version__}" "User Commands"',
        f".SH NAME\n{escaped(NAME)} \\- {escaped(cli.help or '')}",
        f".SH SYNOPSIS\n.B {escaped(NAME)}\n[OPTIONS] COMMAND [ARGS]...\n.SH OPTIONS",
        *options(cli, context),
        ".SH COMMANDS",
    ]
    for path, command, inner in commands(cli, context):
        usage = " ".join(command.collect_usage_pieces(inner))
        lines.append(f".SS {escaped(path.removeprefix(NAME + ' '))} {escaped(usage)}\n{escaped(command.help or '')}")
        lines += options(command, inner)
        if command.epilog:
            lines.append(f".PP\n{escaped(command.epilog)}")
    return "\n".join(lines) + ENDING


if __name__ == "__main__":
    print(page(), end="")
