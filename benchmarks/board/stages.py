"""Marks for `instruction_counter.c`: which stage of the daemon's work the program is in.

A mark is the system call umask with the stage above the nine bits that the kernel looks at: it cannot fail and costs a
few hundred instructions, two for each call of a marked function.
"""

from __future__ import annotations

import functools
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager

#: In the order of the table. `not counted`: what the board would not do (making the devices' bytes).
STAGES = (
    "start", "not counted", "decode", "main loop", "dead reckoning", "angles", "health", "contacts", "drag",
    "scan matching", "keyframe", "back-end, rest", "closures", "optimise", "map", "publish", "store", "end",
)  # fmt: skip
#: What happens for every whisker frame, whatever the robot does; scan matching is due every few centimetres.
EVERY_FRAME = ("decode", "main loop", "dead reckoning", "angles", "health", "contacts", "drag", "publish")

_UMASK = 0o022
_stack = [STAGES.index("start")]


def begin(stage: str) -> None:
    """Everything from here on belongs to this stage."""
    _stack[-1] = STAGES.index(stage)
    os.umask(_stack[-1] + 1 << 9 | _UMASK)


@contextmanager
def within(stage: str) -> Iterator[None]:
    """A stage within another."""
    _enter(STAGES.index(stage))
    try:
        yield
    finally:
        _leave()


def mark(owner: object, name: str, stage: str) -> None:
    """Count the calls of a function, `owner.name`, as this stage."""
    function: Callable[..., object] = getattr(owner, name)
    number = STAGES.index(stage)

    @functools.wraps(function)
    def marked(*args: object, **named: object) -> object:
        _enter(number)
        try:
            return function(*args, **named)
        finally:
            _leave()

    setattr(owner, name, marked)


def _enter(number: int) -> None:
    _stack.append(number)
    os.umask(number + 1 << 9 | _UMASK)


def _leave() -> None:
    _stack.pop()
    os.umask(_stack[-1] + 1 << 9 | _UMASK)
