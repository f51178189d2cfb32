"""What an evaluation keeps of one replay: which run it was, and its figures."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from typing import Any

from robominer_slam.evaluation.consistency import Consistency
from robominer_slam.evaluation.height_errors import HeightErrors
from robominer_slam.evaluation.metrics import ErrorStatistics

#: What a file name may say where the recording does not: `scenario-3`, `odometry-7`.
SCENARIO = re.compile(r"scenario[-_ ]?([0-9]+)", re.IGNORECASE)
ODOMETRY_SEED = re.compile(r"(?:odometry|odometry[-_]seed|seed|odo)[-_ ]?([0-9]+)$", re.IGNORECASE)


class ResultsError(ValueError):
    """Saved results that cannot be used; one line that says which and why."""


@dataclass(frozen=True, slots=True)
class DriveName:
    """Which drive a recording holds.

    Attributes:
        drive: the same for recordings that differ in the ready-made odometry's noise only: `scenario 3`.
        odometry_seed: that noise; None where nothing says it.
    """

    drive: str
    odometry_seed: int | None

    @classmethod
    def of(cls, stem: str, metadata: Mapping[str, str]) -> DriveName:
        """From a recording's metadata, or else from the stem of its file name."""
        text = metadata.get("odometry_seed", "")
        named = ODOMETRY_SEED.search(stem)
        seed = int(text) if text.isdecimal() else int(named[1]) if named else None
        if "scenario" not in metadata:
            scenario = SCENARIO.search(stem)
            base = stem[: named.start()].rstrip("-_ ") if named else stem
            return cls(f"scenario {scenario[1]}" if scenario else base or stem, seed)
        drive = f"scenario {metadata['scenario']}"
        if metadata.get("world", "thesis") != "thesis":
            drive = f"{metadata['world']}, {drive}"
        # The simulator's own default needs no words.
        if metadata.get("seed", "1") != "1":
            drive += f", seed {metadata['seed']}"
        return cls(drive, seed)


@dataclass(frozen=True, slots=True)
class RunKey:
    """Which run: drive, odometry noise, method of SLAM, source of odometry, and what was set otherwise."""

    drive: str
    odometry_seed: int | None
    method: str
    source: str
    variant: str = ""

    @property
    def series(self) -> str:
        """Method and variant, as legends and tables name them."""
        return f"{self.method}, {self.variant}" if self.variant else self.method

    @property
    def conditions(self) -> tuple[str, int | None, str]:
        """What runs must share to be compared with each other."""
        return self.drive, self.odometry_seed, self.source


@dataclass(frozen=True, slots=True)
class ClosureCounts:
    """Loop closures of the final graph.

    Attributes:
        total: all of them.
        true: weight over 0.1 after the robust kernel, and right.
        wrong: weight over 0.1 and over 0.10 m or 5 deg from the truth: those that survive.
    """

    total: int
    true: int
    wrong: int


@dataclass(frozen=True)
class RunRecord:
    """Figures of one replay.

    Attributes:
        key: which run.
        recording: stem of the recording's file name.
        frames: whisker frames within the time that the truth covers.
        duration_s: from the first to the last of them.
        distance_m: length of the true path.
        replay_s: time that the replay took, reading included.
        cpu_s: processor time of it, of all threads; says more on a busy machine.
        slam_position_m, slam_heading_deg: of the poses as published.
        odometry_position_m, odometry_heading_deg: of the same run's dead reckoning.
        slam_distance_m, slam_rotation_deg: of the poses as published, in all three dimensions.
        slam_relative_m, odometry_relative_m: drift within 25 frames, a second; None for shorter drives.
        keyframes: number of them.
        closures: loop closures.
        height: the map against the true surface; None where that is not known or there is no map.
        consistency: covariance against error.
        states: share of the frames by state of the localisation.
        frame_s: processor's wall time per frame without a keyframe, reading included; None where not measured.
        keyframe_s: likewise of frames that completed a keyframe, with the back-end's work.
    """

    key: RunKey
    recording: str
    frames: int
    duration_s: float
    distance_m: float
    replay_s: float
    cpu_s: float
    slam_position_m: ErrorStatistics
    slam_heading_deg: ErrorStatistics
    odometry_position_m: ErrorStatistics
    odometry_heading_deg: ErrorStatistics
    slam_distance_m: ErrorStatistics
    slam_rotation_deg: ErrorStatistics
    slam_relative_m: ErrorStatistics | None
    odometry_relative_m: ErrorStatistics | None
    keyframes: int
    closures: ClosureCounts
    height: HeightErrors | None
    consistency: Consistency
    states: dict[str, float]
    frame_s: ErrorStatistics | None = None
    keyframe_s: ErrorStatistics | None = None

    @property
    def real_time_factor(self) -> float:
        """How many times faster than real time the replay went."""
        return self.duration_s / self.replay_s

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        return {**asdict(self), "real_time_factor": self.real_time_factor}

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> RunRecord:
        """Back from JSON.

        Raises:
            ResultsError: a key is missing, or one that nobody knows.
        """
        kinds: dict[str, Any] = {
            "key": RunKey,
            "closures": ClosureCounts,
            "height": HeightErrors,
            "consistency": Consistency,
            **dict.fromkeys(
                (field.name for field in fields(cls) if "ErrorStatistics" in str(field.type)), ErrorStatistics
            ),
        }
        try:
            values = {
                name: kinds[name](**value) if name in kinds and value is not None else value
                for name, value in data.items()
                if name != "real_time_factor"
            }
            return cls(**values)
        except TypeError as error:
            raise ResultsError(f"not a run's record of this version: {error}") from error
