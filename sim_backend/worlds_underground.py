"""Worlds for the RM3 layout: a single tunnel, and mines of galleries with loops."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from sim_backend.galleries import Galleries, Roughness
from sim_backend.ground import HeightField
from sim_backend.scene import World

FloatArray = NDArray[np.float64]

#: Floor under base_link, m: floor whiskers are mounted at 0.265, reach to 0.115 and press 2 cm.
FLOOR_Z = 0.135
#: Narrow enough that the wall rows touch on both sides, m (interfaces: 0.86 to 0.92).
WIDTH = 0.88
#: Radius of junctions, m: the corners of the array pass 0.55 m from the centre when the robot turns.
CHAMBER = 0.62
FLOOR_DEVIATION, WALL_DEVIATION = 0.012, 0.012


def tunnel(seed: int = 11, length: float = 30.0) -> World:
    """One winding gallery, driven to its end and back."""
    rng = np.random.default_rng(seed)
    heading = np.cumsum(rng.uniform(-0.35, 0.35, round(length / 3.0)))
    heading -= heading[0]
    steps = 3.0 * np.stack([np.cos(heading), np.sin(heading)], axis=-1)
    nodes = np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)])
    edges = np.stack([np.arange(len(nodes) - 1), np.arange(1, len(nodes))], axis=-1)
    there = list(range(len(nodes)))
    return _world("tunnel", rng, nodes, edges, {1: there, 2: [*there, *there[-2::-1]]})


def mine(seed: int = 12, rows: int = 5, columns: int = 6, spacing: float = 8.0, name: str = "mine") -> World:
    """Galleries on a bent grid, every tenth street closed where a way round is left.

    Scenario 1 drives two loops, scenario 2 every gallery at least once and back to the start.
    """
    rng = np.random.default_rng(seed)
    column, row = np.meshgrid(np.arange(columns), np.arange(rows))
    nodes = spacing * np.stack([column.ravel(), row.ravel()], axis=-1).astype(np.float64)
    nodes[1:] += rng.uniform(-0.12, 0.12, (len(nodes) - 1, 2)) * spacing
    index = np.arange(rows * columns).reshape(rows, columns)
    streets = [
        *zip(index[:, :-1].ravel().tolist(), index[:, 1:].ravel().tolist(), strict=True),
        *zip(index[:-1].ravel().tolist(), index[1:].ravel().tolist(), strict=True),
    ]
    for k in sorted(rng.permutation(len(streets))[: len(streets) // 10], reverse=True):
        fewer = streets[:k] + streets[k + 1 :]
        if 0 not in streets[k] and len(_reachable(fewer)) == len(nodes):
            streets = fewer
    edges = np.array(streets, dtype=np.intp)
    tour = _tour_of_all(edges)
    return _world(name, rng, nodes, edges, {1: tour[:12], 2: tour})


def mine_of(seed: int, length: float) -> World:
    """A random mine with at least `length` metres of galleries."""
    spacing, side = 8.0, 3
    # Of the 2 n (n + 1) - (2 n + 1) streets of n rows and n + 1 columns a tenth may be closed, and bends lengthen.
    while 0.88 * spacing * (2 * side * side - 1) < length:
        side += 1
    return mine(seed, side, side + 1, spacing, name=f"mine:{seed}:{length:g}")


def _world(
    name: str, rng: np.random.Generator, nodes: FloatArray, edges: NDArray[np.intp], tours: dict[int, list[int]]
) -> World:
    # The robot starts looking along the first street of its tours.
    first = nodes[next(iter(tours.values()))[1]] - nodes[0]
    turn = np.arctan2(first[1], first[0])
    R = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    nodes = (nodes - nodes[0]) @ R
    galleries = Galleries(
        nodes,
        edges,
        WIDTH,
        CHAMBER,
        FLOOR_Z,
        Roughness.random(rng, FLOOR_DEVIATION, 0.3, 3.0).level(),
        Roughness.random(rng, WALL_DEVIATION, 0.2, 2.0),
        nodes[0],
    )
    x = np.arange(-1.5, 1.5 + 0.025, 0.05)
    around = HeightField((-1.5, -1.5), 0.05, galleries.height(*np.meshgrid(x, x)))
    return World(
        name,
        around,
        (),
        {number: _waypoints(nodes[tour]) for number, tour in tours.items()},
        layout="rm3",
        walls=galleries,
        floor=galleries.height,
    )


def _waypoints(way: FloatArray) -> FloatArray:
    """Drive along the streets, turn in the junctions; shape (m, 3): x, y in m, heading in rad, unwrapped."""
    step = np.diff(way, axis=0)
    heading = np.unwrap(np.arctan2(step[:, 1], step[:, 0]))
    stops = [[*way[0], 0.0]]
    for place, following, angle in zip(way[:-1], way[1:], heading, strict=True):
        if angle != stops[-1][2]:
            stops.append([*place, angle])
        stops.append([*following, angle])
    return np.array(stops)


def _neighbours(edges: list[tuple[int, int]]) -> dict[int, list[int]]:
    found: dict[int, list[int]] = {}
    for a, b in edges:
        found.setdefault(int(a), []).append(int(b))
        found.setdefault(int(b), []).append(int(a))
    return found


def _reachable(edges: list[tuple[int, int]]) -> set[int]:
    """Nodes that streets connect with node 0."""
    near, seen, waiting = _neighbours(edges), {0}, [0]
    while waiting:
        new = set(near.get(waiting.pop(), [])) - seen
        seen |= new
        waiting += sorted(new)
    return seen


def _tour_of_all(edges: NDArray[np.intp]) -> list[int]:
    """Nodes of a tour from node 0 through every street and back: always the nearest street not yet driven."""
    near = _neighbours([(int(a), int(b)) for a, b in edges])
    left = {frozenset((int(a), int(b))) for a, b in edges}
    tour = [0]
    while left:
        way = _shortest(near, tour[-1], lambda node: any(frozenset((node, other)) in left for other in near[node]))
        tour += way[1:]
        following = next(other for other in near[tour[-1]] if frozenset((tour[-1], other)) in left)
        left.remove(frozenset((tour[-1], following)))
        tour.append(following)
    return [*tour, *_shortest(near, tour[-1], lambda node: node == 0)[1:]]


def _shortest(near: dict[int, list[int]], start: int, wanted: Callable[[int], bool]) -> list[int]:
    """Nodes of the shortest way, in streets, from `start` to a wanted node, which may be `start` itself."""
    ways = [[start]]
    seen = {start}
    for way in ways:  # grows while it is walked: breadth first
        if wanted(way[-1]):
            return way
        new = [other for other in near[way[-1]] if other not in seen]
        seen.update(new)
        ways += [[*way, other] for other in new]
    raise ValueError(f"no way from node {start} to a wanted one")
