"""The whisker array as the page draws it: where each whisker sits, which way it points, how long it is."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np

from drivers.ros_messages import deserialize
from robominer_slam import geometry
from robominer_slam.layout import BUILT_IN, WhiskerLayout
from robominer_slam.publishing.pose_messages import TF_MESSAGE

#: Frames of the whiskers in `tf_static`, as the robot's publisher names them.
_WHISKER_FRAME = re.compile(r"whisker_(\d+)_(\d+)")


def layout_of_mounts(payload: bytes, rows: int, cols: int) -> WhiskerLayout | None:
    """The array that `tf_static` describes; None if it names no whisker.

    Lengths do not travel: where a built-in layout has the same mounts its lengths count, else 0.15 m.

    Args:
        payload: TFMessage.
        rows, cols: of the array; 0, 0 where they are not known: as far as the names go.

    Raises:
        MessageError: bytes that are no such message.
    """
    mounts: dict[tuple[int, int], np.ndarray[tuple[int, ...], np.dtype[np.float64]]] = {}
    for transform in deserialize(payload, TF_MESSAGE).transforms:
        if found := _WHISKER_FRAME.fullmatch(transform.child_frame_id):
            t, q = transform.transform.translation, transform.transform.rotation
            mounts[int(found[1]), int(found[2])] = np.array([t.x, t.y, t.z, q.x, q.y, q.z, q.w])
    if not mounts:
        return None
    rows = max(rows, 1 + max(row for row, _ in mounts))
    cols = max(cols, 1 + max(col for _, col in mounts))
    vectors = np.zeros((rows * cols, 7))
    vectors[:, 6] = 1.0
    present = np.zeros(rows * cols, dtype=np.bool_)
    for (row, col), vector in mounts.items():
        vectors[row * cols + col] = vector
        present[row * cols + col] = True
    T = geometry.from_vector7(vectors)
    length = np.full(rows * cols, 0.15)
    layout = WhiskerLayout("robot", rows, cols, T[:, :3, 3], T[:, :3, :3], length, present)
    for build in BUILT_IN.values():
        known = build()
        if known.p_base.shape == layout.p_base.shape and np.allclose(known.p_base, layout.p_base, atol=1e-6):
            return replace(layout, name=known.name, length=known.length)
    return layout


def default_layout(rows: int, cols: int) -> WhiskerLayout | None:
    """The built-in layout of this size, until the robot says more; None if there is none."""
    for build in BUILT_IN.values():
        layout = build()
        if (layout.rows, layout.cols) == (rows, cols):
            return layout
    return None
