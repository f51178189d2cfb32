"""Parameters that bound the memory of the method `robust` and its time per keyframe."""

from __future__ import annotations

from robominer_slam.configuration.parameter import Section, parameter


class BoundedMapSection(Section):
    """What is optimised, and what is kept, however long the drive."""

    small_map: int = parameter(
        200, "1", "keyframes, 50 m, up to which all are matched with all passes and keep their touches", low=0,
        high=1_000_000,
    )  # fmt: skip
    local_window: int = parameter(
        100, "1", "keyframes that move where closures agree; graphs no larger are always solved whole",
        low=10, high=100_000,
    )  # fmt: skip
    local_distance: float = parameter(
        0.03, "m", "closures farther than this from the estimate move the whole graph", low=0.0, high=1.0
    )
    local_angle_deg: float = parameter(1.5, "deg", "as local_distance", low=0.0, high=45.0)
    full_every: int = parameter(
        200, "1", "keyframes with closures after which the whole graph is solved anyway", low=1, high=100_000
    )
    sure_span: int = parameter(
        4, "1", "keyframes since an accepted closure for which odometry, 1 m of it, is as sure as closures are",
        low=0, high=100,
    )  # fmt: skip
    sure_spacing: int = parameter(
        2, "1", "of so many sure keyframes one is matched, with one pass: patches of 0.5 m share the rest", low=1,
        high=100,
    )  # fmt: skip
    refresh: int = parameter(
        16, "1", "keyframes after which covariances take new closures in: 4 m; until then they are too large",
        low=1, high=10_000,
    )  # fmt: skip
    covered_share: float = parameter(
        0.95, "1", "of a keyframe's touches on ground mapped before: it adds no points to the map", low=0.5, high=1.0
    )
    covered_cell: float = parameter(
        0.04, "m", "touches this near cover: lines of touches are 32 mm apart", low=0.005, high=0.5
    )
    max_keyframes: int = parameter(
        1000, "1", "of the graph: solving all of it takes 25 ms, on the board 0.6 s", low=50, high=1_000_000
    )
    tie_spacing: int = parameter(
        4, "1", "of so many keyframes without touches one stays as long as others can go: its closures hold the map",
        low=2, high=1000,
    )  # fmt: skip
    merge_extent: float = parameter(
        1.0, "m", "way that merged keyframes span at most: their drift within is no longer corrected", low=0.0,
        high=100.0,
    )  # fmt: skip
    merge_voxel: float = parameter(
        0.02, "m", "touches of merged keyframes closer than this are one: a cell of the closures' search", low=0.001,
        high=0.2,
    )  # fmt: skip
    max_points_in_memory: int = parameter(
        300_000, "1", "touches that stay in memory (12 byte each); more are paged to disk", low=10_000,
        high=1_000_000_000,
    )  # fmt: skip
