"""What goes over the bus: messages received, queries, answers, and the errors of asking."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple


class Received(NamedTuple):
    """A message or an answer.

    Attributes:
        key: under the prefix where it lies there, else in full.
        payload: the bytes.
        encoding: such as `application/cdr;sensor_msgs/msg/Imu`.
        attachment: small bytes that travel beside the payload.
    """

    key: str
    payload: bytes
    encoding: str
    attachment: bytes | None

    @property
    def schema(self) -> str:
        """What follows the semicolon of the encoding: a ROS message's type."""
        return self.encoding.partition(";")[2]


class Query(NamedTuple):
    """A question.

    Attributes:
        key: as in `Received`.
        parameters: of its selector.
        payload: the bytes.
        sender: who asks, for the log, as far as the links tell (`senders.py`).
    """

    key: str
    parameters: Mapping[str, str]
    payload: bytes
    sender: str = ""


class Reply(NamedTuple):
    """An answer; without an encoding it has that of the key it answers on."""

    payload: bytes
    encoding: str | None = None


class QueryRefusedError(Exception):
    """To be raised by who answers a query: the text goes to who asked, as an error."""


class QueryError(Exception):
    """Nobody answered a query, or all who did answered with an error."""


def parameters_of(text: str) -> dict[str, str]:
    """Parameters of a selector; by hand, as the binding's own iteration is not what its types declare."""
    pairs = (part.partition("=") for part in text.split(";") if part)
    return {name: value for name, _, value in pairs}
