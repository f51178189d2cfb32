"""What came of a command to the robot: done, refused, or unanswered - three things that must never look alike."""

from __future__ import annotations

import json
from dataclasses import dataclass
from enum import Enum


class Outcome(Enum):
    """Of a command."""

    DONE = "done"
    REFUSED = "refused"
    UNANSWERED = "unanswered"


@dataclass(frozen=True, slots=True)
class CommandResult:
    """What came of a command, and what the robot said, or why nobody did."""

    outcome: Outcome
    message: str


def result_of(payload: bytes) -> CommandResult:
    """The result in an answer {"ok", "message"}; what is no such answer counts as refused."""
    try:
        answer = json.loads(payload)
        return CommandResult(Outcome.DONE if answer["ok"] is True else Outcome.REFUSED, str(answer["message"]))
    except (ValueError, TypeError, KeyError):
        return CommandResult(Outcome.REFUSED, f"the robot's answer cannot be read: {payload[:100]!r}")
