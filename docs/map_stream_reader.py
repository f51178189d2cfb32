"""Reads the map stream with nothing but Python's own library: the reference to docs/map-stream.md.

reader = MapReader()
reader.feed(payload)      # of map/updates, or of an answer to map/snapshot; as often as they come
reader.keyframes          # {id: (stamp in ns, pose (7 numbers), [(x, y, z), ...] in units of 5 mm)}
"""

import hashlib
import itertools
import struct
import zlib

HEADER = struct.Struct("<4sBBHQIIIHH8s")
Keyframe = tuple[int, tuple[int, ...], list[tuple[int, ...]]]


def numbers(body: bytes, at: int, count: int) -> tuple[list[int], int]:
    """So many numbers of seven bits a byte, the sign in the lowest bit, and the place behind them."""
    found = []
    for _ in range(count):
        value = shift = 0
        while True:
            byte = body[at]
            at += 1
            value |= (byte & 127) << shift
            shift += 7
            if byte < 128:
                break
        found.append(-(value + 1) // 2 if value & 1 else value // 2)
    return found, at


def apply(known: dict[int, Keyframe], body: bytes) -> dict[int, Keyframe]:
    """The keyframes after a body's records."""
    keyframes, at = {key: (stamp, pose, list(points)) for key, (stamp, pose, points) in known.items()}, 0
    while at < len(body):
        tag, key = struct.unpack_from("<BI", body, at)
        at += 5
        if tag == 1:
            stamp, _count = struct.unpack_from("<qI", body, at)
            keyframes[key] = (stamp, struct.unpack_from("<3i4h", body, at + 12), [])
            at += 32
        elif tag == 2:
            (count,) = struct.unpack_from("<H", body, at)
            steps, at = numbers(body, at + 2, 3 * count)
            columns = [itertools.accumulate(steps[axis * count : (axis + 1) * count]) for axis in range(3)]
            keyframes[key][2].extend(zip(*columns, strict=True))
        elif tag == 3:
            stamp, _, points = keyframes[key]
            keyframes[key] = (stamp, struct.unpack_from("<3i4h", body, at), points)
            at += 20
        else:
            del keyframes[key]
    return keyframes


def digest(map_id: int, version: int, keyframes: dict[int, Keyframe]) -> bytes:
    """Of a state, as headers and `status` have it."""
    state = hashlib.blake2b(struct.pack("<QII", map_id, version, len(keyframes)), digest_size=8)
    for key, (stamp, pose, points) in sorted(keyframes.items()):
        rows = hashlib.blake2b(b"".join(struct.pack("<3h", *point) for point in points), digest_size=16)
        state.update(struct.pack("<IqI3i4h", key, stamp, len(points), *pose) + rows.digest())
    return state.digest()


class MapReader:
    """A copy of the map; `wanting` says that `map/snapshot` has to be asked for."""

    def __init__(self) -> None:
        self.stream: tuple[int, int] | None = None
        self.version, self.wanting = 0, False
        self.keyframes: dict[int, Keyframe] = {}
        self.parts: dict[tuple[int, ...], dict[int, bytes]] = {}

    def feed(self, payload: bytes) -> None:
        """Take the messages of a payload."""
        at = 0
        while at < len(payload):
            _, form, kind, size, map_id, epoch, base, version, part, parts, goal = HEADER.unpack_from(payload, at)
            at += HEADER.size + size
            key = (kind, map_id, epoch, base, version, parts)
            if form != 2 or ((map_id, epoch) == self.stream and version <= self.version):
                continue
            self.parts.setdefault(key, {})[part] = zlib.decompress(payload[at - size : at])
            if len(self.parts[key]) == parts:
                self.take(key, b"".join(body for _, body in sorted(self.parts.pop(key).items())), goal)

    def take(self, key: tuple[int, ...], body: bytes, goal: bytes) -> None:
        """Apply a complete update or snapshot if it fits and its digest holds."""
        kind, map_id, epoch, base, version, _ = key
        whole = kind == 2 or (base == 0 and (map_id, epoch) != self.stream)
        self.wanting = not whole and ((map_id, epoch) != self.stream or base != self.version)
        if self.wanting:
            return
        keyframes = apply({} if whole else self.keyframes, body)
        self.wanting = digest(map_id, version, keyframes) != goal
        if not self.wanting:
            self.stream, self.version, self.keyframes = (map_id, epoch), version, keyframes
