"""The configuration model: every parameter of the program in one place."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, ValidationInfo, field_validator

from robominer_slam.configuration.device_section import DeviceSection
from robominer_slam.configuration.load_section import LoadSection
from robominer_slam.configuration.log_section import LogSection
from robominer_slam.configuration.parameter import KeyChunk, Section, is_ros_name, parameter
from robominer_slam.configuration.robust_estimation_section import RobustEstimationSection
from robominer_slam.configuration.robust_slam_section import RobustSlamSection
from robominer_slam.configuration.zenoh_section import ZenohSection


class RobotSection(Section):
    """Which robot this is."""

    id: KeyChunk = parameter("rm3", "", "part of every key on the network: robominer/<id>/...")
    layout: str = parameter("thesis-grid", "", "built-in name (thesis-grid, rm3) or path of a layout file")
    role: Literal["all", "drivers", "slam"] = parameter(
        "all", "", "drivers: devices to the network only; slam: from the network; all: both on one board"
    )


class TopicsSection(Section):
    """Names of a recording's topics, for replay of other people's recordings."""

    whiskers: str = parameter("whiskers", "", "robominer_msgs/msg/WhiskerArray")
    imu: str = parameter("imu", "", "sensor_msgs/msg/Imu")
    screws: str = parameter("screws", "", "sensor_msgs/msg/JointState")
    front_right_motor: str = parameter("front_right/motor_module", "", "robominer_msgs/msg/MotorModuleFeedback")
    rear_right_motor: str = parameter("rear_right/motor_module", "", "as front_right_motor")
    rear_left_motor: str = parameter("rear_left/motor_module", "", "as front_right_motor")
    front_left_motor: str = parameter("front_left/motor_module", "", "as front_right_motor")
    odometry: str = parameter("odometry/twist", "", "geometry_msgs/msg/TwistStamped, a ready-made odometry")
    ground_truth: str = parameter("ground_truth", "", "nav_msgs/msg/Odometry, where a simulator knows it")


class ContactSection(Section):
    """When a whisker counts as touching."""

    min_inclination_deg: float = parameter(
        4.0, "deg", "at rest the noise is 0.3 to 0.5 deg; 4 deg is a tip raised by 0.4 mm", low=0.5, high=30.0
    )
    max_inclination_deg: float = parameter(
        70.0, "deg", "beyond this the rod lies along the surface and the tip assumption fails", low=20.0, high=85.0
    )
    flow_bend_deg: float = parameter(
        10.0, "deg", "rods less inclined than this may be free in flowing water: 0.75 m/s bends them by 8 deg",
        low=1.0, high=45.0,
    )  # fmt: skip
    flow_spread_deg: float = parameter(
        1.8, "deg", "eddies and noise turn 98 % of free rods by less from their common bend", low=0.2, high=10.0
    )
    flow_whiskers: int = parameter(
        5, "1", "rods that must agree for a flow; more than the whiskers of the array: never", low=2, high=100_000
    )


class ScrewsSection(Section):
    """Geometry of the four screws; values of RM3 (Centre for Biorobotics)."""

    radius: float = parameter(0.078, "m", "screw radius of RM3", low=0.005, high=1.0)
    helix_angle_deg: float = parameter(30.0, "deg", "helix angle of RM3's screws", low=5.0, high=80.0)
    half_track: float = parameter(0.15, "m", "lx: from the centre to a screw along x", low=0.01, high=5.0)
    half_base: float = parameter(0.30, "m", "ly: from the centre to a screw along y", low=0.01, high=5.0)


class EstimationSection(Section):
    """Dead reckoning: the filter over body velocity, heading and gyro bias."""

    source: Literal["fused", "odometry"] = parameter(
        "fused", "", "fused: IMU and screws; odometry: the ready-made odometry alone"
    )
    sigma_screws_vx: float = parameter(
        0.02, "m/s", "white part of the screws' error; RM3's crew found 0.16 in a regression that has slip in it",
        low=1e-4, high=10.0,
    )  # fmt: skip
    sigma_screws_vy: float = parameter(0.02, "m/s", "as for vx", low=1e-4, high=10.0)
    sigma_screws_wz: float = parameter(
        0.015, "rad/s", "encoder noise through the kinematics; makes the gyro's bias visible on straight drives",
        low=1e-4, high=10.0,
    )  # fmt: skip
    screw_slip: float = parameter(
        0.2,
        "1",
        "share of each velocity that slip may eat: 2 to 30 % on the grounds that RM3 has seen",
        low=0.0,
        high=1.0,
    )
    screw_slip_turn: float = parameter(
        1.0,
        "1",
        "as screw_slip, for the turn rate: slip lasts seconds and would pass for gyro bias",
        low=0.0,
        high=10.0,
    )
    sigma_gyro: float = parameter(0.005, "rad/s", "BNO080 per sample at 100 Hz with margin", low=1e-5, high=1.0)
    sigma_gyro_bias_start: float = parameter(0.002, "rad/s", "0.1 deg/s: a BNO080's bias at start", low=0.0, high=0.1)
    gyro_bias_walk: float = parameter(1e-5, "rad/s/sqrt(s)", "slow drift of a consumer gyro", low=0.0, high=0.01)
    acceleration_walk: float = parameter(
        0.3,
        "m/s2/sqrt(Hz)",
        "how fast the robot's velocity may change: it accelerates at 0.2 m/s2",
        low=0.01,
        high=50.0,
    )
    angular_acceleration_walk: float = parameter(
        2.0, "rad/s2/sqrt(Hz)", "how fast the turn rate may change", low=0.01, high=100.0
    )
    still_screw_speed: float = parameter(
        0.05, "rad/s", "all screws slower than this: the robot stands, velocity zero", low=0.0, high=10.0
    )
    position_walk: float = parameter(
        0.02, "m/sqrt(m)", "slip: how the position error grows with the distance driven", low=0.0, high=1.0
    )
    reorder_window: float = parameter(
        0.5, "s", "measurements wait at most this long for an older one from another port", low=0.05, high=5.0
    )


class ThesisSection(Section):
    """The thesis's pipeline; what it leaves unsaid comes from a search on scenario 3 (docs/slam.md)."""

    matcher: Literal["ICP", "PLANE_ICP", "GICP", "VGICP"] = parameter(
        "GICP", "", "the thesis chose FAST_GICP by visual inspection"
    )
    keyframe_distance: float = parameter(0.12, "m", "thesis 3.4.4: along x or y", low=0.01, high=5.0)
    keyframe_angle: float = parameter(1.54, "rad", "thesis 3.4.4", low=0.05, high=6.3)
    resolution: float = parameter(0.1, "m", "thesis 3.4.4: registration resolution", low=0.005, high=1.0)
    search_radius: float = parameter(0.75, "m", "thesis 3.4.4: candidates within it", low=0.05, high=20.0)
    max_fitness: float = parameter(0.016, "m2", "thesis 3.4.4: mean squared distance", low=1e-6, high=1.0)
    scan_voxel: float = parameter(0.05, "m", "voxel filter per scan: by search", low=0.0, high=0.5)
    correspondence_distance: float = parameter(0.1, "m", "of points in a match: by search", low=0.01, high=10.0)
    min_travel: float = parameter(
        1.0, "m", "driven since the candidate before a closure: by search", low=0.0, high=100.0
    )
    closure_spacing: float = parameter(0.0, "m", "driven between two closures: by search", low=0.0, high=100.0)
    kernel: Literal["none", "huber", "cauchy"] = parameter("huber", "", "kernel of the closures: by search")
    odometry_sigma: float = parameter(
        0.01,
        "m, rad",
        "of an odometry edge; 0: from the scans' fitness, as hdl_graph_slam: by search",
        low=0.0,
        high=1.0,
    )


class SlamSection(Section):
    """Simultaneous localisation and mapping."""

    method: Literal["robust", "thesis", "none"] = parameter(
        "robust", "", "robust: this project's; thesis: its pipeline; none: odometry alone"
    )
    start: Literal["new", "continue", "localize"] = parameter(
        "new", "", "new: an empty map; continue: go on with a saved one; localize: follow the pose in it, unchanged"
    )
    map: str = parameter("", "", "name or id of the saved map; empty: the newest")
    backend_latency: float = parameter(
        0.5, "s", "a keyframe's result takes effect this long after it, in sensor time, so that replay equals run",
        low=0.0, high=60.0,
    )  # fmt: skip
    backend_queue: int = parameter(
        16, "1", "keyframes that may wait for the back-end; beyond, the front-end waits", low=1, high=1000
    )
    thesis: ThesisSection = Field(default_factory=ThesisSection)
    robust: RobustSlamSection = Field(default_factory=RobustSlamSection)


class HealthSection(Section):
    """When a whisker is not believed, and how its rest position is followed (docs/calibration.md)."""

    window: int = parameter(
        18, "1", "frames looked at: at 25 a second, a fault is found within a second", low=5, high=1000
    )
    every: int = parameter(5, "1", "frames from one look to the next: a fifth of the cost", low=1, high=100)
    dead_frames: int = parameter(
        5, "1", "RM3's firmware takes five readings of zeros in a row for an error", low=2, high=1000
    )
    stuck_frames: int = parameter(
        15, "1", "a reading repeats by chance once in 80 frames, 15 times never, even with half the noise",
        low=3, high=1000,
    )  # fmt: skip
    saturation: float = parameter(129.0, "mT", "the TLV493D's range ends at 130 mT", low=1.0, high=1000.0)
    noise: float = parameter(
        1.2, "mT", "ten times a healthy sensor's 0.12; rods dragged over rough ground stay under 0.9",
        low=0.1, high=50.0,
    )  # fmt: skip
    least_strength: float = parameter(
        0.2, "1", "of the field at rest; a whole magnet bent by 75 deg still has 0.36", low=0.01, high=0.9
    )
    greatest_strength: float = parameter(
        1.5, "1", "of the field at rest; no bend makes more than 1.1 of a whole magnet's", low=1.1, high=10.0
    )
    greatest_turn_deg: float = parameter(
        80.0, "deg", "from the field at rest; a rod bent by 75 deg turns its field by 65", low=30.0, high=180.0
    )
    idle_deg: float = parameter(4.0, "deg", "as contact.min_inclination_deg", low=0.5, high=30.0)
    bent_neighbours_deg: float = parameter(
        12.0, "deg", "where all neighbours are bent by that, a whole rod between them is bent too", low=5.0, high=45.0
    )
    moved: float = parameter(
        0.05, "m", "within the window: where the ground passes under it, no whole rod stays at rest",
        low=0.005, high=1.0,
    )  # fmt: skip
    against: float = parameter(
        0.6, "m", "after turning back, a rod trails again within its length of 0.15 m; at obstacles within 0.45",
        low=0.1, high=10.0,
    )  # fmt: skip
    recovery: float = parameter(1.5, "s", "without a fault before a whisker is believed again", low=0.1, high=60.0)
    rest_deg: float = parameter(
        2.0, "deg", "a reading this near rest may be rest: half of the least contact angle", low=0.2, high=10.0
    )
    rest_noise_deg: float = parameter(
        0.7, "deg", "standard deviation of a tilt at rest: the noise makes 0.5 deg", low=0.1, high=5.0
    )
    rest_distance: float = parameter(
        0.05, "m", "the robot moves so far while the reading stays: ground would have moved the rod", low=0.01, high=1.0
    )
    rest_trail_deg: float = parameter(
        0.3, "deg", "a mean tilt against the motion by more than this may be a tip that is dragged", low=0.05, high=5.0
    )
    rest_rate: float = parameter(
        0.01, "deg/s", "fastest re-zeroing: ten times the drift of a warming robot, 3 deg an hour",
        low=0.0, high=1.0,
    )  # fmt: skip
    drift_deg: float = parameter(
        5.0, "deg", "a rest position that has crept so far from the calibrated one is no drift of a whole whisker",
        low=1.0, high=30.0,
    )  # fmt: skip


class MapSection(Section):
    """The map as it is published."""

    point_voxel: float = parameter(0.01, "m", "points of a keyframe closer than this are one", low=0.001, high=0.5)
    stream_cell: float = parameter(
        0.03,
        "m",
        "the map stream tells one point of each cell of ground: 1 KB for a metre of gallery",
        low=0.005,
        high=0.5,
    )
    grid_cell: float = parameter(0.05, "m", "cell of the published occupancy grid", low=0.005, high=1.0)
    obstacle_height: float = parameter(
        0.04, "m", "a step within a cell's neighbourhood that makes it an obstacle", low=0.005, high=1.0
    )


class StoreSection(Section):
    """Where keyframes are kept."""

    path: str = parameter("/var/lib/robominer-slam/map.db", "", "SQLite database of the maps")
    sync_s: float = parameter(
        2.0, "s", "a keyframe is on the disk at most this long after it was made", low=0.1, high=60.0
    )
    max_mb: float = parameter(
        200.0, "MB", "of the database at most, 80 000 keyframes: the oldest maps are thinned then, unnamed ones first",
        low=1.0, high=100_000.0,
    )  # fmt: skip
    point_voxel: float = parameter(
        0.02, "m", "touches of a keyframe closer than this are stored as one: a cell of the search, 1 KB a keyframe",
        low=0.0, high=0.2,
    )  # fmt: skip


class Configuration(Section):
    """The whole configuration file."""

    robot: RobotSection = Field(default_factory=RobotSection)
    device: tuple[DeviceSection, ...] = ()
    topics: TopicsSection = Field(default_factory=TopicsSection)
    contact: ContactSection = Field(default_factory=ContactSection)
    health: HealthSection = Field(default_factory=HealthSection)
    screws: ScrewsSection = Field(default_factory=ScrewsSection)
    estimation: EstimationSection = Field(default_factory=EstimationSection)
    robust_estimation: RobustEstimationSection = Field(default_factory=RobustEstimationSection)
    slam: SlamSection = Field(default_factory=SlamSection)
    map: MapSection = Field(default_factory=MapSection)
    store: StoreSection = Field(default_factory=StoreSection)
    zenoh: ZenohSection = Field(default_factory=ZenohSection)
    load: LoadSection = Field(default_factory=LoadSection)
    log: LogSection = Field(default_factory=LogSection)

    @field_validator("zenoh")
    @classmethod
    def _ros_can_say_the_name(cls, value: ZenohSection, info: ValidationInfo) -> ZenohSection:
        robot = info.data.get("robot")
        if value.ros != "none" and robot is not None and not is_ros_name(robot.id):
            raise ValueError(
                f"expected with ros = {value.ros!r} a robot.id that ROS takes for a name (letters, digits and single "
                f"underscores, no digit first), found {robot.id!r}"
            )
        return value

    @field_validator("device")
    @classmethod
    def _names_differ(cls, value: tuple[DeviceSection, ...]) -> tuple[DeviceSection, ...]:
        names = [device.name for device in value]
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise ValueError(f"expected a name of its own for each device, {', '.join(twice)} stands twice")
        return value
