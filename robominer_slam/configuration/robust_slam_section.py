"""Parameters of the SLAM method `robust`. None of them may depend on the world."""

from __future__ import annotations

from pydantic import Field

from robominer_slam.configuration.bounded_map_section import BoundedMapSection
from robominer_slam.configuration.parameter import Section, parameter
from robominer_slam.configuration.relocalisation_section import RelocalisationSection


class SurfaceSection(Section):
    """How touches make a surface."""

    touch_sigma: float = parameter(
        0.0012, "m", "of a touch's height: 0.46 deg after calibration at rods of 0.15 m", low=1e-4, high=0.1
    )
    curvature: float = parameter(
        3.0, "1/m", "ground leaves its tangent plane by this times d^2: relief of 2 cm at 50 cm wavelength", low=0.0,
        high=100.0,
    )  # fmt: skip
    slope_sigma: float = parameter(0.3, "1", "slope of rough ground", low=0.01, high=10.0)
    reach: float = parameter(0.045, "m", "lines of touches are 32 mm apart in the thesis's grid", low=0.005, high=0.5)


class ScanMatchingSection(Section):
    """Scan matching with the ground touched lately."""

    enabled: bool = parameter(True, "", "match scans with the local map")
    step: float = parameter(0.02, "m", "way between two matches: half of the pitch of the rows", low=0.001, high=1.0)
    keep: float = parameter(
        3.0, "m", "way after which touches leave the local map: drift stays within a match's reach", low=0.2, high=50.0
    )
    age: float = parameter(
        0.05, "m", "way after which touches enter it: what was just written confirms the drift", low=0.0, high=1.0
    )
    cell: float = parameter(0.02, "m", "cells of the local map", low=0.002, high=0.2)
    per_cell: int = parameter(3, "1", "touches that a cell keeps", low=1, high=100)
    rebuild: float = parameter(0.05, "m", "way between two updates of the target", low=0.0, high=1.0)
    associations: int = parameter(1, "1", "how often planes are looked up in a match", low=1, high=10)
    least_inliers: float = parameter(0.4, "1", "share of touches that must fit", low=0.0, high=1.0)
    share: float = parameter(
        0.2, "1", "of the touches' information that counts: they share their whiskers' errors", low=1e-4, high=1.0
    )


class ClosureSection(Section):
    """Loop closures: search and checks."""

    enabled: bool = parameter(True, "", "search for loop closures")
    min_travel: float = parameter(
        3.0, "m", "way since the ground was touched: nearer ground is in the local map", low=0.1, high=100.0
    )
    patch: float = parameter(0.5, "m", "keyframes merged for a match reach this far back", low=0.05, high=5.0)
    target_radius: float = parameter(0.7, "m", "keyframes this near make up a target", low=0.1, high=10.0)
    max_targets: int = parameter(2, "1", "passes tried per keyframe", low=1, high=20)
    sigmas: float = parameter(3.0, "1", "half size of the search in sigmas of the prediction", low=1.0, high=10.0)
    min_window: float = parameter(
        0.12, "m", "least half size: alternatives must be seen to be ruled out", low=0.01, high=5.0
    )
    max_window: float = parameter(1.2, "m", "greatest half size: bounds the time", low=0.05, high=20.0)
    max_window_walls: float = parameter(
        4.0,
        "m",
        "as max_window where there are walls: patches with walls are unlike each other, and galleries come back late",
        low=0.05,
        high=20.0,
    )
    min_yaw_window_deg: float = parameter(8.0, "deg", "as min_window", low=0.5, high=180.0)
    max_yaw_window_deg: float = parameter(60.0, "deg", "as max_window", low=1.0, high=180.0)
    cell: float = parameter(0.02, "m", "of the search's grid", low=0.005, high=0.2)
    yaw_step_deg: float = parameter(2.0, "deg", "between headings: one cell at the patch's rim", low=0.2, high=30.0)
    points: int = parameter(400, "1", "touches used in a match", low=30, high=10_000)
    min_overlap: float = parameter(0.4, "1", "share of touches on ground touched before", low=0.05, high=1.0)
    min_inliers: float = parameter(0.8, "1", "share of those that must fit", low=0.1, high=1.0)
    min_contrast: float = parameter(
        1.5, "1", "the ground's relief over what is left of it: flat ground fits everywhere", low=0.0, high=100.0
    )
    uniqueness: float = parameter(1.3, "1", "cost of the next best place over that of the best", low=1.0, high=100.0)
    max_moved: float = parameter(
        4.0, "1", "distance from the prediction in sigmas, three axes: 0.1 % by chance", low=1.0, high=100.0
    )
    max_sigma: float = parameter(0.025, "m", "a match that leaves a direction free is none", low=0.001, high=1.0)
    max_sigma_along: float = parameter(
        0.04,
        "m",
        "as max_sigma, along walls that hold all else: with 0.08, 3 of 147 were more than 0.1 off, with this none",
        low=0.001,
        high=1.0,
    )
    max_sigma_yaw_deg: float = parameter(2.5, "deg", "as max_sigma", low=0.1, high=45.0)
    inflation: float = parameter(
        40.0,
        "1",
        "touches share errors, and so do patches that follow each other: variance over that of independence",
        low=1.0,
        high=1000.0,
    )
    floor: float = parameter(
        0.007,
        "m",
        "least sigma of a closure: what whiskers have in common goes through a whole pass",
        low=0.0,
        high=0.1,
    )
    floor_yaw_deg: float = parameter(1.2, "deg", "as floor", low=0.0, high=10.0)
    agreement: float = parameter(
        16.3, "1", "chi-square of two closures' difference (three axes): 0.1 % by chance", low=1.0, high=1000.0
    )
    partners: int = parameter(1, "1", "other closures that must agree before one counts", low=0, high=10)
    partner_span: int = parameter(6, "1", "keyframes within which partners are looked for", low=1, high=100)
    take_back: float = parameter(
        25.0, "1", "chi-square in the optimised graph at which a closure is taken back", low=1.0, high=1000.0
    )


class RobustSlamSection(Section):
    """The method `robust`."""

    keyframe_distance: float = parameter(0.25, "m", "half of what the array covers", low=0.02, high=5.0)
    keyframe_angle: float = parameter(0.5, "rad", "the rim moves by half of the array", low=0.05, high=6.3)
    point_voxel: float = parameter(0.01, "m", "touches of a keyframe closer than this are one", low=0.001, high=0.2)
    bias_unknown: bool = parameter(True, "", "slow biases of the odometry are unknowns of the graph")
    surface: SurfaceSection = Field(default_factory=SurfaceSection)
    scan_matching: ScanMatchingSection = Field(default_factory=ScanMatchingSection)
    closure: ClosureSection = Field(default_factory=ClosureSection)
    relocalisation: RelocalisationSection = Field(default_factory=RelocalisationSection)
    bounds: BoundedMapSection = Field(default_factory=BoundedMapSection)
