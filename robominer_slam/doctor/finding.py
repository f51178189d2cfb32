"""What a check has found."""

from __future__ import annotations

from typing import Literal, NamedTuple

Level = Literal["ok", "warning", "error"]


class Finding(NamedTuple):
    """One check's outcome.

    Attributes:
        check: what was looked at, such as `certificate`.
        level: only errors make the doctor discontent.
        message: what is so.
        mend: the command or the act that mends it; empty where nothing is to be mended.
    """

    check: str
    level: Level
    message: str
    mend: str = ""
