"""Which decoder belongs to which protocol."""

from __future__ import annotations

from collections.abc import Callable
from typing import get_args

from drivers.bno08x_rvc import Bno08xRvcDecoder
from drivers.framed import FramedDecoder
from drivers.mip import MipDecoder
from drivers.readings import Decoder
from drivers.rm3_compressed import Rm3CompressedDecoder
from drivers.rm3_motor import Rm3MotorDecoder
from drivers.rm3_plaintext import Rm3PlaintextDecoder
from drivers.rm3_values import Representation
from drivers.settings import Protocol

PROTOCOLS: tuple[Protocol, ...] = get_args(Protocol)

_PLAIN: dict[Protocol, Callable[[], Decoder]] = {
    "framed": FramedDecoder,
    "rm3-motor": Rm3MotorDecoder,
    "bno08x-rvc": Bno08xRvcDecoder,
    "mip": MipDecoder,
}


def make_decoder(
    protocol: Protocol, rows: int = 8, cols: int = 8, representation: Representation = "spherical"
) -> Decoder:
    """A fresh decoder; the array's size and representation matter to RM3's whisker protocols only."""
    if protocol == "rm3-plaintext":
        return Rm3PlaintextDecoder(rows, cols, representation)
    if protocol == "rm3-compressed":
        return Rm3CompressedDecoder(rows, cols, representation)
    return _PLAIN[protocol]()
