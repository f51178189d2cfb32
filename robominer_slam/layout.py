"""Where each whisker sits on the robot: base position, mount rotation, length.

Layouts are data: two are built in (interfaces: `thesis-grid`, `rm3`), others come from a JSON file with the
same fields. A whisker's own frame has z along the rod at rest, from base to tip.
"""

from __future__ import annotations

import json
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

#: Whisker frame of a floor whisker in base_link: x forward, y right, z down.
R_DOWN = np.diag([1.0, -1.0, -1.0])


class LayoutError(ValueError):
    """A layout that cannot be used; the message says what, where and what was expected."""


@dataclass(frozen=True, slots=True)
class WhiskerLayout:
    """Geometry of a whisker array of `rows` x `cols` whiskers, row-major.

    Attributes:
        name: the layout's name; a calibration carries it too.
        rows, cols: size of the array.
        p_base: base positions in base_link, shape (rows * cols, 3), m.
        R_base_whisker: mount rotations, whisker frame to base_link, shape (rows * cols, 3, 3).
        length: rod lengths, shape (rows * cols,), m.
        present: False where the array has a hole, shape (rows * cols,).
    """

    name: str
    rows: int
    cols: int
    p_base: FloatArray
    R_base_whisker: FloatArray
    length: FloatArray
    present: NDArray[np.bool_]

    @property
    def count(self) -> int:
        """Number of places in the array, holes included."""
        return self.rows * self.cols

    def __post_init__(self) -> None:
        n = self.rows * self.cols
        shapes = {
            "p_base": (self.p_base.shape, (n, 3)),
            "R_base_whisker": (self.R_base_whisker.shape, (n, 3, 3)),
            "length": (self.length.shape, (n,)),
            "present": (self.present.shape, (n,)),
        }
        for name, (found, expected) in shapes.items():
            if found != expected:
                raise LayoutError(f"layout {self.name}: {name} has shape {found}, expected {expected}")
        if not (np.isfinite(self.p_base).all() and np.isfinite(self.length).all()):
            raise LayoutError(f"layout {self.name}: positions and lengths must be finite numbers in metres")
        if (self.length <= 0.0).any():
            raise LayoutError(f"layout {self.name}: every whisker needs a length above 0 m")
        error = np.abs(self.R_base_whisker @ self.R_base_whisker.transpose(0, 2, 1) - np.eye(3)).max()
        if error > 1e-6 or (np.linalg.det(self.R_base_whisker) < 0.0).any():
            raise LayoutError(f"layout {self.name}: a mount rotation is not a rotation (error {error:.1e})")


def thesis_grid() -> WhiskerLayout:
    """The thesis's flat 8 x 8 grid: 39 mm by 64 mm pitch, odd rows shifted by -32 mm in y, pointing down.

    Source: Nagel 2021, section 2.2 and figure 9; row 0 is the front row, column 0 the leftmost.
    """
    rows, cols = 8, 8
    row, col = np.divmod(np.arange(rows * cols), cols)
    p = np.zeros((rows * cols, 3))
    p[:, 0] = -row * 0.039
    p[:, 1] = -col * 0.064 - np.where(row % 2 == 1, 0.032, 0.0)
    p[:, :2] -= p[:, :2].mean(axis=0)
    return WhiskerLayout(
        name="thesis-grid",
        rows=rows,
        cols=cols,
        p_base=p,
        R_base_whisker=np.broadcast_to(R_DOWN, (rows * cols, 3, 3)).copy(),
        length=np.full(rows * cols, 0.15),
        present=np.ones(rows * cols, dtype=np.bool_),
    )


def _frame(z_axis: FloatArray, x_hint: FloatArray) -> FloatArray:
    """Rotation whose z column is `z_axis` and whose x column is `x_hint` made perpendicular to it."""
    z = z_axis / np.linalg.norm(z_axis)
    x = x_hint - (x_hint @ z) * z
    x /= np.linalg.norm(x)
    return np.column_stack([x, np.cross(z, x), z])


def rm3() -> WhiskerLayout:
    """RM3's simulated array: six floor rows, one row each right, left, rear and front (interfaces: `rm3`)."""
    rows, cols = 10, 8
    n = rows * cols
    p = np.zeros((n, 3))
    R = np.broadcast_to(R_DOWN, (n, 3, 3)).copy()
    # Columns of rows 0 to 7 run forward along x; of rows 8 and 9 along y, column 0 on the right.
    x_of_col = -0.0345 + (np.arange(cols) - 3) * 0.075
    y_of_col = (np.arange(cols) - (cols - 1) / 2) * 0.075
    tilt = np.pi - 2.15
    forward, left, down = np.array([1.0, 0, 0]), np.array([0, 1.0, 0]), np.array([0, 0, -1.0])
    for row in range(rows):
        k = slice(row * cols, (row + 1) * cols)
        if row < 6:
            p[k] = np.column_stack([x_of_col, np.full(cols, -0.20 + 0.08 * row), np.full(cols, 0.265)])
        else:
            outward = {6: -left, 7: left, 8: -forward, 9: forward}[row]
            z = np.cos(tilt) * down + np.sin(tilt) * outward
            R[k] = _frame(z, forward if row < 8 else left)
            if row < 8:
                p[k] = np.column_stack([x_of_col, np.full(cols, 0.35 * outward[1]), np.full(cols, 0.31)])
            else:
                p[k] = np.column_stack([np.full(cols, 0.405 * outward[0]), y_of_col, np.full(cols, 0.31)])
    return WhiskerLayout("rm3", rows, cols, p, R, np.full(n, 0.15), np.ones(n, dtype=np.bool_))


BUILT_IN = {"thesis-grid": thesis_grid, "rm3": rm3}


def to_json(layout: WhiskerLayout) -> str:
    """The layout as the text of a layout file."""
    return json.dumps(
        {
            "format": "robominer-slam layout",
            "version": 1,
            "name": layout.name,
            "rows": layout.rows,
            "cols": layout.cols,
            "whiskers": [
                {
                    "row": int(i // layout.cols),
                    "col": int(i % layout.cols),
                    "position_m": layout.p_base[i].tolist(),
                    "rotation": layout.R_base_whisker[i].tolist(),
                    "length_m": float(layout.length[i]),
                }
                for i in np.flatnonzero(layout.present)
            ],
        },
        indent=1,
    )


def from_json(text: str, where: str) -> WhiskerLayout:
    """Parse a layout file's text.

    Args:
        text: the file's content; places that the list of whiskers leaves out are holes.
        where: the file's name, for messages.

    Raises:
        LayoutError: not JSON, a missing field, a place outside the array or named twice, not a rotation.
    """
    try:
        data = json.loads(text)
        rows, cols = int(data["rows"]), int(data["cols"])
        if not (1 <= rows <= 64 and 1 <= cols <= 64):
            raise LayoutError(f"{where}: rows and cols must be 1 to 64, found {rows} x {cols}")
        n = rows * cols
        p, R = np.zeros((n, 3)), np.broadcast_to(R_DOWN, (n, 3, 3)).copy()
        length, present = np.full(n, 0.15), np.zeros(n, dtype=np.bool_)
        for whisker in data["whiskers"]:
            row, col = int(whisker["row"]), int(whisker["col"])
            if not (0 <= row < rows and 0 <= col < cols):
                raise LayoutError(f"{where}: whisker ({row}, {col}) lies outside the {rows} x {cols} array")
            i = row * cols + col
            if present[i]:
                raise LayoutError(f"{where}: whisker ({row}, {col}) is named twice")
            present[i] = True
            p[i], R[i], length[i] = whisker["position_m"], whisker["rotation"], whisker["length_m"]
        name = str(data["name"])
    except LayoutError:
        raise
    except KeyError as error:
        raise LayoutError(f"{where}: the layout lacks the field {error}") from error
    except (TypeError, ValueError) as error:
        raise LayoutError(f"{where}: not a layout file ({error})") from error
    return WhiskerLayout(name, rows, cols, p, R, length, present)
