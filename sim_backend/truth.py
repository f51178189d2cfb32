"""Ground truth on disk while the robot drives: TUM text, one line per whisker frame."""

from __future__ import annotations

from pathlib import Path
from types import TracebackType

from sim_backend.events import TruthEvent


class TruthFile:
    """Writes `timestamp tx ty tz qx qy qz qw` lines: UNIX seconds, m, unit quaternion of T_map_base."""

    def __init__(self, path: Path) -> None:
        """Create the file, an existing one is overwritten; raises OSError if that fails."""
        self.path = path
        self._file = path.open("w", encoding="utf-8")
        self._file.write("# timestamp tx ty tz qx qy qz qw\n")
        self._file.flush()

    def __enter__(self) -> TruthFile:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._file.close()

    def write(self, truth: TruthEvent, stamp_ns: int) -> None:
        """Write a pose with its stamp, and flush, so that others can follow."""
        values = " ".join(f"{value:.9f}" for value in (*truth.position, *truth.orientation_xyzw))
        seconds, fraction = divmod(stamp_ns, 1_000_000_000)
        self._file.write(f"{seconds}.{fraction:09d} {values}\n")
        self._file.flush()
