"""The g2o text format of pose graphs: to and from text, no files.

| line                                   | fields after the numbers of the nodes                                |
|----------------------------------------|----------------------------------------------------------------------|
| VERTEX_SE2 id                          | x y theta                                                            |
| EDGE_SE2 i j                           | x y theta, upper triangle of Omega (6 numbers)                       |
| VERTEX_SE3:QUAT id                     | x y z qx qy qz qw                                                    |
| EDGE_SE3:QUAT i j                      | x y z qx qy qz qw, upper triangle of Omega (21 numbers)              |
| FIX id ...                             | nodes that do not move                                               |

m and rad; Omega row by row with translation first. Empty lines and comments (#) are skipped. Numbers are written
with 17 significant digits, which a double survives unchanged.

Source: Kuemmerle et al., "g2o: a general framework for graph optimization" (ICRA 2011), and its wiki, "File format".
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from robominer_slam import geometry
from robominer_slam.geometry import FloatArray

_VERTEX = {"VERTEX_SE2": 2, "VERTEX_SE3:QUAT": 3}
_EDGE = {"EDGE_SE2": 2, "EDGE_SE3:QUAT": 3}
_TAGS = (*_VERTEX, *_EDGE, "FIX")
_POSE_NUMBERS = {2: 3, 3: 7}
_INFORMATION_NUMBERS = {2: 6, 3: 21}


class G2oFormatError(ValueError):
    """Text that is not a pose graph in g2o's format; the message says where, what, and what was expected."""


@dataclass(frozen=True, slots=True)
class G2oGraph:
    """A pose graph as it stands in a g2o file.

    Attributes:
        dim: 2 or 3.
        ids: numbers of the nodes in the file, in its order, shape (n,).
        poses: (n, 3) as (x, y, theta) or (n, 4, 4); m and rad.
        i, j: edges, as indices into `ids` (not numbers of the file), shape (m,).
        measurements: T_i_j, (m, 3) or (m, 4, 4).
        information: Omega, shape (m, d, d), d = 3 or 6, translation first.
        fixed: nodes of FIX lines, as indices into `ids`.
    """

    dim: Literal[2, 3]
    ids: NDArray[np.int64]
    poses: FloatArray
    i: NDArray[np.int64]
    j: NDArray[np.int64]
    measurements: FloatArray
    information: FloatArray
    fixed: tuple[int, ...] = ()


@dataclass(frozen=True, slots=True)
class _Line:
    """One line with fields: where it is, its tag and what follows it."""

    where: str
    tag: str
    fields: list[str]

    def fail(self, message: str) -> G2oFormatError:
        return G2oFormatError(f"{self.where}: {message}")

    def node(self, index: int) -> int:
        try:
            return int(self.fields[index])
        except ValueError:
            raise self.fail(f"{self.tag}: node number {self.fields[index]!r} is not an integer") from None

    def numbers(self, first: int) -> list[float]:
        try:
            return [float(field) for field in self.fields[first:]]
        except ValueError as error:
            raise self.fail(f"{self.tag}: {error}; expected numbers") from None


def parse_g2o(text: str, name: str = "g2o text") -> G2oGraph:
    """Read a pose graph.

    Args:
        text: the content of the file.
        name: of the file, for messages.

    Raises:
        G2oFormatError: an unknown tag, a wrong count of numbers, a number that is not finite, a node twice or not
            at all, a quaternion of length 0, a mixture of plane and space, or no node; with file and line.
    """
    lines = [
        _Line(f"{name}, line {number}", fields[0], fields[1:])
        for number, fields in enumerate((line.partition("#")[0].split() for line in text.splitlines()), start=1)
        if fields
    ]
    for line in lines:
        if line.tag not in _TAGS:
            raise line.fail(f"tag {line.tag!r} is not known; expected one of {', '.join(_TAGS)}")
    vertices = [line for line in lines if line.tag in _VERTEX]
    edges = [line for line in lines if line.tag in _EDGE]
    if not vertices:
        raise G2oFormatError(f"{name}: no node; expected VERTEX_SE2 or VERTEX_SE3:QUAT lines")
    dim: Literal[2, 3] = 2 if vertices[0].tag == "VERTEX_SE2" else 3
    for line in (*vertices, *edges):
        if (_VERTEX | _EDGE)[line.tag] != dim:
            raise line.fail(f"{line.tag} in a graph that began with {vertices[0].tag}; expected one kind per file")
    k, triangle = _POSE_NUMBERS[dim], _INFORMATION_NUMBERS[dim]
    vertex_numbers = _table(vertices, 1, k)
    edge_numbers = _table(edges, 2, k + triangle)
    index: dict[int, int] = {}
    for line in vertices:
        node = line.node(0)
        if node in index:
            raise line.fail(f"node {node} stands here for the second time; expected each node once")
        index[node] = len(index)
    ends = np.array([[_known(line, 0, index), _known(line, 1, index)] for line in edges], dtype=np.int64)
    i, j = ends.reshape(-1, 2).T
    for m in np.flatnonzero(i == j)[:1]:
        raise edges[m].fail(f"the edge joins node {edges[m].fields[0]} with itself; expected two nodes")
    return G2oGraph(
        dim=dim,
        ids=np.array(list(index), dtype=np.int64),
        poses=_poses(dim, vertices, vertex_numbers),
        i=i,
        j=j,
        measurements=_poses(dim, edges, edge_numbers[:, :k]),
        information=_symmetric(edge_numbers[:, k:], 3 if dim == 2 else 6),
        fixed=tuple(_known(line, n, index) for line in lines if line.tag == "FIX" for n in range(len(line.fields))),
    )


def format_g2o(graph: G2oGraph) -> str:
    """Text of a pose graph, 17 significant digits, nodes first, then FIX lines, then edges."""
    vertex, edge = ("VERTEX_SE2", "EDGE_SE2") if graph.dim == 2 else ("VERTEX_SE3:QUAT", "EDGE_SE3:QUAT")
    ids = graph.ids.tolist()
    rows, columns = np.triu_indices(graph.information.shape[-1])
    out = [
        f"{vertex} {node} {_numbers(pose)}"
        for node, pose in zip(ids, _pose_numbers(graph.dim, graph.poses), strict=True)
    ]
    out += [f"FIX {ids[node]}" for node in graph.fixed]
    out += [
        f"{edge} {ids[i]} {ids[j]} {_numbers(pose)} {_numbers(triangle)}"
        for i, j, pose, triangle in zip(
            graph.i.tolist(),
            graph.j.tolist(),
            _pose_numbers(graph.dim, graph.measurements),
            graph.information[:, rows, columns],
            strict=True,
        )
    ]
    return "\n".join(out) + "\n"


def _table(lines: Sequence[_Line], nodes: int, count: int) -> FloatArray:
    """Numbers after the node numbers, shape (len(lines), count), all finite."""
    table = np.empty((len(lines), count))
    for row, line in zip(table, lines, strict=True):
        if len(line.fields) != nodes + count:
            raise line.fail(
                f"{line.tag} has {len(line.fields)} fields; expected {nodes + count}: {nodes} node number"
                f"{'s' * (nodes > 1)} and {count} numbers"
            )
        row[:] = line.numbers(nodes)
    for k in np.flatnonzero(~np.isfinite(table).all(axis=1))[:1]:
        raise lines[k].fail(f"{lines[k].tag}: a number is not finite")
    return table


def _known(line: _Line, field: int, index: dict[int, int]) -> int:
    node = line.node(field)
    if node not in index:
        raise line.fail(f"{line.tag}: node {node} has no VERTEX line")
    return index[node]


def _poses(dim: int, lines: Sequence[_Line], numbers: FloatArray) -> FloatArray:
    if dim == 2:
        return numbers
    for k in np.flatnonzero(~numbers[:, 3:].any(axis=1))[:1]:
        raise lines[k].fail(f"{lines[k].tag}: the quaternion is zero; expected x y z w of length 1")
    return geometry.from_vector7(numbers)


def _pose_numbers(dim: int, poses: FloatArray) -> FloatArray:
    return poses if dim == 2 else geometry.to_vector7(poses)


def _symmetric(triangles: FloatArray, d: int) -> FloatArray:
    rows, columns = np.triu_indices(d)
    out = np.zeros((triangles.shape[0], d, d))
    out[:, rows, columns] = triangles
    out[:, columns, rows] = triangles
    return out


def _numbers(values: FloatArray) -> str:
    return " ".join(f"{value:.17g}" for value in values.tolist())
