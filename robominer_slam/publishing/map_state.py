"""The map as the map stream carries it: keyframes with quantised poses and points, and the state's digest.

Both ends hold exactly this, so that a digest can say whether they hold the same. See docs/map-stream.md.
"""

from __future__ import annotations

import hashlib
import struct
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robominer_slam import geometry
from robominer_slam.publishing.point_bytes import PointArray, ordered

FloatArray = NDArray[np.float64]

MILLIMETRES_PER_METRE = 1000.0
#: Points are told to 5 mm: what a whisker knows of a touch is 1 to 2 mm, and each millimetre costs 0.3 bytes a point.
POINT_UNIT_M = 0.005
#: Of a point from its keyframe, along an axis: differences of two then still fit three bytes.
FARTHEST_M = 32.0
#: A quaternion's component of 1.
QUATERNION_UNIT = 32767.0
DIGEST_BYTES = 8
#: x y z in mm, qx qy qz qw in 1/32767.
POSE = struct.Struct("<3i4h")
_POINTS_DIGEST_BYTES = 16
_STATE_HEAD = struct.Struct("<QII")
_ID = struct.Struct("<I")
_KEYFRAME_HEAD = struct.Struct("<qI")


@dataclass(frozen=True, slots=True)
class StreamKeyframe:
    """A keyframe as it travels.

    Attributes:
        stamp_ns: UNIX time.
        pose: T_map_base as x y z (mm), qx qy qz qw (1/32767), with qw >= 0.
        points: shape (m, 3), in units of 5 mm, in base_link at the keyframe; once each, in `point_bytes`' order.
        points_digest: of the points.
        packed: what of it goes into the state's digest, behind the id; follows from the others.
    """

    stamp_ns: int
    pose: tuple[int, ...]
    points: PointArray
    points_digest: bytes
    packed: bytes = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        head = _KEYFRAME_HEAD.pack(self.stamp_ns, len(self.points))
        object.__setattr__(self, "packed", head + POSE.pack(*self.pose) + self.points_digest)

    def vector7(self) -> FloatArray:
        """T_map_base as x y z (m), qx qy qz qw of length 1; shape (7,)."""
        vector: FloatArray = vectors7([self.pose])[0]
        return vector

    def points_m(self) -> FloatArray:
        """Points in base_link at the keyframe, shape (m, 3), m."""
        metres: FloatArray = self.points.astype(np.float64) * POINT_UNIT_M
        return metres


@dataclass(slots=True)
class MapState:
    """A map at a version; the empty map has version 0."""

    map_id: int
    version: int = 0
    keyframes: dict[int, StreamKeyframe] = field(default_factory=dict)

    def digest(self) -> bytes:
        """BLAKE2b of 8 bytes over the whole state, independent of how it came about."""
        state = hashlib.blake2b(digest_size=DIGEST_BYTES)
        state.update(_STATE_HEAD.pack(self.map_id, self.version, len(self.keyframes)))
        keyframes = self.keyframes
        state.update(b"".join([_ID.pack(key) + keyframes[key].packed for key in sorted(keyframes)]))
        return state.digest()

    def cloud(self) -> FloatArray:
        """All points in map, shape (m, 3), m."""
        parts = [
            geometry.transform_points(geometry.from_vector7(keyframe.vector7()), keyframe.points_m())
            for keyframe in self.keyframes.values()
        ]
        return np.concatenate(parts) if parts else np.zeros((0, 3))


def keyframe(stamp_ns: int, pose: tuple[int, ...], points: PointArray) -> StreamKeyframe:
    """A keyframe with the digest of its points, which are taken as they are."""
    data = np.ascontiguousarray(points, dtype="<i2").tobytes()
    digest = hashlib.blake2b(data, digest_size=_POINTS_DIGEST_BYTES).digest()
    return StreamKeyframe(stamp_ns, pose, points, digest)


def vectors7(poses: ArrayLike) -> FloatArray:
    """Poses of keyframes in m, quaternions of length 1: x y z qx qy qz qw; shape (n, 7)."""
    values = np.array(poses, dtype=np.float64)
    values[:, :3] /= MILLIMETRES_PER_METRE
    values[:, 3:] /= np.linalg.norm(values[:, 3:], axis=1, keepdims=True)
    return values


def quantise_poses(poses: ArrayLike) -> NDArray[np.int32]:
    """Poses x y z (m), qx qy qz qw, shape (n, 7), in the stream's units, with qw >= 0.

    Raises:
        ValueError: a number that is not finite.
    """
    values = np.array(poses, dtype=np.float64).reshape(-1, 7)
    if not np.isfinite(values).all():
        raise ValueError("a keyframe's pose is not finite")
    values[:, 3:] /= np.linalg.norm(values[:, 3:], axis=1, keepdims=True)
    values[values[:, 6] < 0.0, 3:] *= -1.0
    values[:, :3] *= MILLIMETRES_PER_METRE
    values[:, 3:] *= QUATERNION_UNIT
    return np.rint(values).astype(np.int32)


def quantise_points(points: ArrayLike) -> tuple[PointArray, int]:
    """Points (m, 3), m, in the stream's units, each once and sorted; and how many had to be left out.

    Left out is what is not finite or farther than 32 m from the keyframe along an axis.
    """
    values = np.rint(np.asarray(points, dtype=np.float64).reshape(-1, 3) / POINT_UNIT_M)
    usable = (np.abs(values) <= FARTHEST_M / POINT_UNIT_M).all(axis=1)
    kept = values[usable].astype(np.int16)
    return ordered(kept), len(values) - len(kept)
