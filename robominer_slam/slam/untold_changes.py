"""Changes of a session's graph that the map has not been told of, because keyframes are held back."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, field, replace

from robominer_slam.slam.keyframe import BackendResult, GraphEdge, Merge


@dataclass
class UntoldChanges:
    """Collects what results say, and says it with the next one that the map gets.

    Attributes:
        edges: new ones.
        dropped, removed, merged, bare: as in `BackendResult`.
    """

    edges: list[GraphEdge] = field(default_factory=list)
    dropped: list[tuple[int, int]] = field(default_factory=list)
    removed: list[int] = field(default_factory=list)
    merged: list[Merge] = field(default_factory=list)
    bare: list[int] = field(default_factory=list)

    def note(self, result: BackendResult) -> None:
        """Take the changes of a result."""
        if result.dropped:
            self.edges = [e for e in self.edges if e.kind != "loop" or (e.i, e.j) not in result.dropped]
        self.edges += result.added or ()
        self.dropped += result.dropped
        self.removed += result.removed
        self.merged += result.merged
        self.bare += result.bare

    def told(self, result: BackendResult, held: Collection[int]) -> BackendResult:
        """The result with all changes but for edges of keyframes that are held back; they are told then."""
        ready = tuple(e for e in self.edges if e.i not in held and e.j not in held)
        told = replace(
            result,
            added=ready,
            dropped=tuple(self.dropped),
            removed=tuple(self.removed),
            merged=tuple(self.merged),
            bare=tuple(self.bare),
        )
        self.edges = [e for e in self.edges if e.i in held or e.j in held]
        self.dropped, self.removed, self.merged, self.bare = [], [], [], []
        return told
