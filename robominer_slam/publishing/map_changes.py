"""When each keyframe of the map stream came, changed and went: what a receiver that was away has missed."""

from __future__ import annotations

from dataclasses import dataclass

#: Keyframes that have gone are remembered, so many; who missed more gets the whole map.
MAX_REMEMBERED_GONE = 4096


@dataclass(slots=True)
class _Versions:
    """Of a keyframe: the versions in which it came, its points changed last, and anything of it changed last."""

    born: int
    points: int
    any: int


@dataclass(frozen=True, slots=True)
class Missed:
    """What a receiver has missed: keyframes to send whole, poses to send, keyframes to remove; ids, growing."""

    whole: list[int]
    poses: list[int]
    gone: list[int]


class MapChanges:
    """Versions of the map's changes, bounded."""

    def __init__(self) -> None:
        self._versions: dict[int, _Versions] = {}
        #: Keyframes that have gone, in the order in which they went: version in which they came and went.
        self._gone: dict[int, tuple[int, int]] = {}
        self._forgotten = 0

    def whole(self, key: int, version: int) -> None:
        """A keyframe came, or came again with other points."""
        known = self._versions.get(key)
        born = version if known is None else known.born
        self._versions[key] = _Versions(born, version, version)

    def moved(self, key: int, version: int) -> None:
        """A keyframe's pose changed."""
        self._versions[key].any = version

    def removed(self, key: int, version: int) -> None:
        """A keyframe went."""
        self._gone[key] = (self._versions.pop(key).born, version)
        while len(self._gone) > MAX_REMEMBERED_GONE:
            _, self._forgotten = self._gone.pop(next(iter(self._gone)))

    def since(self, version: int) -> Missed | None:
        """What changed after a version; None if that is no longer known."""
        if version < self._forgotten:
            return None
        changed = sorted(key for key, one in self._versions.items() if one.any > version)
        return Missed(
            [key for key in changed if self._versions[key].points > version],
            [key for key in changed if self._versions[key].points <= version],
            sorted(key for key, (born, gone) in self._gone.items() if born <= version < gone),
        )
