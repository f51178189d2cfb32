"""Who sent a command, for the log.

Zenoh tells the name in the certificate of each link, but not by which link a query came; and what a query says of its
own source is the sender's word. So: if only one name could have sent it, that is the name. Otherwise the sender's word
chooses among those who could have, and the log says that it is no more than that.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import zenoh

LOCAL = "a program on the robot"


class Peer(NamedTuple):
    """One who is connected and may command.

    Attributes:
        zid: Zenoh's id of the session, as the peer has told it.
        name: in its certificate; None on a link within the machine.
    """

    zid: str
    name: str | None


def sender(peers: Sequence[Peer], claimed: str | None) -> str:
    """Who sent a command, in words.

    Args:
        peers: who could have sent it.
        claimed: the Zenoh id that the query says it comes from.
    """
    names = {peer.zid: peer.name or LOCAL for peer in peers}
    different = sorted(set(names.values()))
    if len(different) == 1:
        return different[0]
    if claimed in names:
        return f"{names[claimed]} (by its own word)"
    if not different:
        return f"Zenoh id {claimed}" if claimed else "unknown"
    return f"one of {', '.join(different)}"


def own_source(session: zenoh.Session, key: str) -> zenoh.SourceInfo:
    """Who we are, to go with a command: where several may command, the robot's log tells them apart by it."""
    # Only what is declared has an identity that can be told.
    with session.declare_querier(key) as querier:
        return zenoh.SourceInfo(querier.id, 0)
