"""The ground touched lately: what enters it, what stays, what leaves."""

from __future__ import annotations

from functools import partial

import numpy as np

from robominer_slam.slam.local_map import LocalMap
from robominer_slam.slam.surface import Surface
from tests.touched_ground import MODEL

KEEP, AGE, CELL = 1.0, 0.1, 0.02


def local_map(per_cell: int = 2, rebuild: float = 0.0) -> LocalMap[Surface]:
    return LocalMap(partial(Surface, model=MODEL), KEEP, AGE, CELL, per_cell, rebuild)


def heights(ground: LocalMap[Surface]) -> list[float]:
    return sorted(ground.surface.points[:, 2].tolist())


def spots(*z: float, x: float = 0.005) -> np.ndarray:
    """Touches in one cell that are told apart by their heights."""
    return np.array([[x, 0.005, h] for h in z])


def test_the_first_touches_of_a_cell_stay_and_later_ones_find_it_full():
    ground = local_map(per_cell=2)
    ground.add(0.0, spots(1.0))
    ground.add(0.1, spots(2.0, 3.0))
    ground.add(0.2, spots(4.0, x=0.025))
    ground.update(0.5, np.zeros(2), 1.0)
    assert heights(ground) == [1.0, 2.0, 4.0]


def test_touches_become_a_target_only_after_some_way():
    ground = local_map()
    ground.add(1.0, spots(1.0))
    ground.update(1.0 + AGE - 0.01, np.zeros(2), 1.0)
    assert heights(ground) == []
    ground.update(1.0 + AGE, np.zeros(2), 1.0)
    assert heights(ground) == [1.0]


def test_old_touches_leave_and_make_room():
    ground = local_map(per_cell=1)
    ground.add(0.0, spots(1.0))
    ground.update(0.5, np.zeros(2), 1.0)
    ground.add(0.9, spots(2.0))
    ground.update(KEEP, np.zeros(2), 1.0)
    assert heights(ground) == [1.0], "as old as may be, and the newer finds the cell taken"
    ground.add(1.0, spots(3.0))
    ground.update(KEEP + AGE + 0.01, np.zeros(2), 1.0)
    assert heights(ground) == [3.0]


def test_the_target_reaches_as_far_as_asked_and_the_rest_is_not_lost():
    ground = local_map()
    ground.add(0.0, np.concatenate([spots(1.0), spots(2.0, x=0.5)]))
    ground.update(0.2, np.zeros(2), 0.3)
    assert heights(ground) == [1.0]
    ground.update(0.3, np.array([0.5, 0.0]), 0.3)
    assert heights(ground) == [2.0]


def test_the_target_is_made_anew_only_after_some_way():
    ground = local_map(rebuild=0.05)
    ground.update(0.0, np.zeros(2), 1.0)
    ground.add(-0.5, spots(1.0))
    ground.update(0.04, np.zeros(2), 1.0)
    assert heights(ground) == []
    ground.update(0.05, np.zeros(2), 1.0)
    assert heights(ground) == [1.0]


def test_negative_places_have_cells_of_their_own():
    ground = local_map(per_cell=1)
    ground.add(0.0, np.array([[x, y, 10 * x + y] for x in (-0.005, 0.005) for y in (-0.005, 0.005)]))
    ground.update(0.2, np.zeros(2), 1.0)
    assert len(ground.surface) == 4


def test_clearing_forgets_what_waits_too():
    ground = local_map()
    ground.add(0.0, spots(1.0))
    ground.update(0.2, np.zeros(2), 1.0)
    ground.add(0.2, spots(2.0))
    ground.clear()
    assert len(ground.surface) == 0
    ground.update(0.9, np.zeros(2), 1.0)
    assert heights(ground) == []
