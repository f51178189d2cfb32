"""Parameters of finding the place in a saved map (docs/slam.md). None of them may depend on the world."""

from __future__ import annotations

from robominer_slam.configuration.parameter import Section, parameter


class RelocalisationSection(Section):
    """Relocalisation in a known map, and how a robot that was carried away is noticed."""

    patch: float = parameter(0.7, "m", "touches of this way are searched for at once", low=0.2, high=5.0)
    window: float = parameter(1.5, "m", "touches of this way must fit together in the end", low=0.3, high=10.0)
    cell: float = parameter(
        0.06, "m", "of the search over the whole map: a third of the shortest wave", low=0.01, high=0.3
    )
    yaw_step_deg: float = parameter(7.5, "deg", "between headings: one cell at the patch's rim", low=0.5, high=30.0)
    reach: float = parameter(1.0, "m", "touches farther from the robot than this are left out", low=0.3, high=10.0)
    points: int = parameter(400, "1", "touches used in a search", low=50, high=10_000)
    candidates: int = parameter(8, "1", "places that are refined", low=2, high=100)
    min_overlap: float = parameter(0.5, "1", "share of touches on mapped ground", low=0.1, high=1.0)
    min_inliers: float = parameter(0.8, "1", "share of those that must fit", low=0.1, high=1.0)
    min_inliers_window: float = parameter(
        0.6, "1", "the same over the whole window, where odometry and map have drifted by a centimetre",
        low=0.1, high=1.0,
    )  # fmt: skip
    min_contrast: float = parameter(
        2.0, "1", "the ground's relief over what is left of it: flat ground fits everywhere", low=0.0, high=100.0
    )
    share: float = parameter(
        0.15, "1", "of the touches' log-likelihood that counts: they share their whiskers' errors", low=1e-3, high=1.0
    )
    margin: float = parameter(
        15.0, "1", "log of the odds against the next best place and against unmapped ground: three million to one",
        low=1.0, high=100.0,
    )  # fmt: skip
    votes: int = parameter(3, "1", "searches that must agree, each sure by itself", low=1, high=20)
    votes_known: int = parameter(2, "1", "the same where the operator has told the place", low=1, high=20)
    dissent: float = parameter(0.25, "1", "votes for other places, of those for the best", low=0.0, high=1.0)
    agreement: float = parameter(0.08, "m", "between two votes: what a match may be off", low=0.01, high=1.0)
    drift: float = parameter(0.05, "1", "of odometry and of the map, over the way between two votes", low=0.0, high=1.0)
    agreement_yaw_deg: float = parameter(4.0, "deg", "as agreement", low=0.5, high=45.0)
    min_overlap_tracking: float = parameter(
        0.6, "1", "share of touches on mapped ground for a contradiction to count", low=0.1, high=1.0
    )
    max_inliers_contradiction: float = parameter(
        0.6, "1", "under this share of fitting touches the map contradicts the place", low=0.0, high=1.0
    )
    contradictions: int = parameter(
        2, "1", "keyframes that the map contradicts after a break, before the robot counts as carried away",
        low=1, high=50,
    )  # fmt: skip
    patience: int = parameter(
        12,
        "1",
        "keyframes after which contradictions are dropped: ground changes; a break is believed",
        low=2,
        high=200,
    )
    elsewhere: float = parameter(
        0.25, "m", "a second opinion this far from where the robot is thought to be contradicts it", low=0.05, high=5.0
    )
    sigma_yaw_deg: float = parameter(25.0, "deg", "of a heading that the operator tells", low=1.0, high=180.0)
