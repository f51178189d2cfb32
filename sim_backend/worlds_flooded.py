"""Flooded worlds: ground with places out of the whiskers' reach, under moving water, with mud in the hollows."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sim_backend.scene import ARRAY_REACH, WHISKER_LENGTH, World, passed_ground
from sim_backend.water import Current, Mud, Water
from sim_backend.worlds_generated import random_world
from sim_backend.worlds_thesis import thesis

#: Share of the ground that the array passes which lies lower than a free rod hangs.
OUT_OF_REACH = 0.35
#: The mud's top above the ends of hanging rods, m: all that hang free dip into it, and some others go through it.
MUD_ABOVE_ENDS = 0.01


def flooded(seed: int | None = None) -> World:
    """The thesis's world, or `random:<seed>`, lowered until whiskers hang free in its hollows, and flooded."""
    dry = thesis() if seed is None else random_world(seed)
    passed = passed_ground(dry.ground, list(dry.scenarios.values()), ARRAY_REACH)
    down = float(np.quantile(dry.ground.z[passed], OUT_OF_REACH)) + WHISKER_LENGTH
    solids = tuple(replace(solid, centre=solid.centre - [0.0, 0.0, down]) for solid in dry.solids)
    current = Current()
    if seed is not None:
        current = Current(seed, direction=float(np.random.default_rng([seed, 11]).uniform(0.0, 2.0 * np.pi)))
    return replace(
        dry,
        name="flooded" if seed is None else f"flooded:{seed}",
        ground=dry.ground.shifted(-down),
        solids=solids,
        water=Water(current, Mud(MUD_ABOVE_ENDS - WHISKER_LENGTH)),
    )
