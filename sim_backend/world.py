"""Worlds that the simulated robot drives through, by name."""

from __future__ import annotations

import re
from collections.abc import Callable
from functools import cache

from sim_backend.scene import ARRAY_REACH, World, WorldError, passed_ground
from sim_backend.worlds_flooded import flooded
from sim_backend.worlds_generated import corridor, flat, random_world
from sim_backend.worlds_thesis import thesis
from sim_backend.worlds_underground import mine, mine_of, tunnel

__all__ = ["ARRAY_REACH", "World", "WorldError", "load", "passed_ground", "thesis"]

BUILT_IN: dict[str, Callable[[], World]] = {
    "thesis": thesis,
    "flat": flat,
    "corridor": corridor,
    "flooded": flooded,
    "tunnel": tunnel,
    "mine": mine,
}
#: Worlds drawn from numbers: `random:<seed>`, `flooded:<seed>` and `mine:<seed>:<metres>`.
RANDOM = re.compile(r"random:([0-9]{1,9})")
FLOODED = re.compile(r"flooded:([0-9]{1,9})")
MINE = re.compile(r"mine:([0-9]{1,9}):([0-9]{1,4})")


@cache
def load(name: str) -> World:
    """A world by name: a built-in one, or one drawn from numbers.

    These are `random:<seed>`, `flooded:<seed>` and `mine:<seed>:<metres of galleries>`.

    Raises:
        WorldError: no world of that name.
    """
    if name in BUILT_IN:
        return BUILT_IN[name]()
    if found := RANDOM.fullmatch(name):
        return random_world(int(found[1]))
    if found := FLOODED.fullmatch(name):
        return flooded(int(found[1]))
    if found := MINE.fullmatch(name):
        return mine_of(int(found[1]), float(found[2]))
    known = ", ".join([*BUILT_IN, "random:<seed>", "flooded:<seed>", "mine:<seed>:<metres>"])
    raise WorldError(f"no world is called {name!r}, expected one of {known}")
