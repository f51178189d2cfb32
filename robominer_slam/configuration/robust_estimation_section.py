"""Parameters of the robust dead reckoning."""

from __future__ import annotations

from robominer_slam.configuration.parameter import Section, parameter


class RobustEstimationSection(Section):
    """Dead reckoning of the method `robust`: one filter over motion, biases, slip, and the drag of the whiskers."""

    drag: bool = parameter(True, "", "use the direction in which whiskers trail as a measurement of motion")
    drag_sigma_deg: float = parameter(
        7.0, "deg", "deviation of one tip's direction: 5 deg on even ground, 10 on rubble", low=0.5, high=45.0
    )
    drag_common_deg: float = parameter(
        1.5, "deg", "deviation of the array's direction as a whole on straight drives", low=0.0, high=45.0
    )
    drag_common_curvature: float = parameter(
        0.1, "rad/m", "as drag_common_deg, of the turn that the array's directions show", low=0.0, high=10.0
    )
    drag_turn_share: float = parameter(
        0.15, "1", "of a turn, the directions may miss: joints that are stiffer across than along", low=0.0, high=1.0
    )
    drag_turn_length: float = parameter(
        5.0, "m", "way over which that stays the same: a loop around one slope", low=0.0, high=100.0
    )
    drag_length: float = parameter(
        0.1, "m", "way over which the array's deviation stays the same (1/e)", low=0.005, high=1.0
    )
    drag_spacing: float = parameter(
        0.03, "m", "way from one measurement to the next: nearer ones say the same", low=0.0, high=0.5
    )
    drag_slide: float = parameter(
        2.2, "rad", "turn of a rod per cross slope at start: 1 / friction and more, less what the fit of slopes misses",
        low=0.0, high=20.0,
    )  # fmt: skip
    drag_sigma_slide: float = parameter(0.8, "rad", "how far a ground's value is from that", low=1e-3, high=10.0)
    drag_slide_length: float = parameter(10.0, "m", "way over which the ground's value changes", low=0.1, high=1e4)
    drag_min_inclination_deg: float = parameter(
        8.0,
        "deg",
        "a rod less inclined has no clear direction: noise of 0.4 deg would turn it by 3",
        low=2.0,
        high=45.0,
    )
    drag_mount_tilt_deg: float = parameter(
        30.0, "deg", "mounts farther from straight down are for walls", low=1.0, high=89.0
    )
    drag_least_speed: float = parameter(
        0.02, "m/s", "of a tip: slower, its direction of motion is not known well", low=0.001, high=1.0
    )
    standstill: bool = parameter(
        True, "", "a ready-made odometry counts as motion only unless the whiskers feel that the robot stands"
    )
    rest_deg: float = parameter(
        0.75, "deg", "rods that turn less in 0.4 s may rest: noise alone is 0.5, at 0.15 m/s they turn by 2 to 6",
        low=0.05, high=10.0,
    )  # fmt: skip
    acceleration_walk: float = parameter(
        0.15, "m/s2/sqrt(Hz)", "0.2 m/s2 for some tenths of a second at a time", low=0.01, high=10.0
    )
    angular_acceleration_walk: float = parameter(
        0.5, "rad/s2/sqrt(Hz)", "as acceleration_walk, for turning", low=0.01, high=50.0
    )
    position_walk: float = parameter(
        0.005, "m/sqrt(m)", "what neither slip nor bias explains, by the distance driven", low=0.0, high=1.0
    )
    sigma_odometry: float = parameter(
        0.05, "m/s, rad/s", "white noise of a ready-made odometry per sample at 30 Hz (thesis 3.4.3)",
        low=1e-4, high=1.0,
    )  # fmt: skip
    sigma_odometry_bias: float = parameter(
        0.004, "m/s, rad/s", "bias of a ready-made odometry: 1 to 5 mm/s and mrad/s, up to 10", low=0.0, high=0.1
    )
    odometry_bias_walk: float = parameter(
        1e-5, "m/s/sqrt(s)", "the bias stays the same for a drive", low=0.0, high=0.01
    )
    sigma_gyro: float = parameter(0.004, "rad/s", "BNO080 per sample: 0.003 and its steps of 0.002", low=1e-5, high=1.0)
    sigma_gyro_bias: float = parameter(0.002, "rad/s", "0.1 deg/s: a BNO080's bias at start", low=0.0, high=0.1)
    gyro_bias_walk: float = parameter(3e-5, "rad/s/sqrt(s)", "slow drift of a consumer gyro", low=0.0, high=0.01)
    sigma_screw_speed: float = parameter(
        0.2, "rad/s", "of one screw's speed per reading, encoder steps and vibration", low=1e-3, high=10.0
    )
    slip_mean: float = parameter(0.16, "1", "middle of the 2 to 30 % that RM3 has seen", low=0.0, high=0.8)
    sigma_slip_mean: float = parameter(0.04, "1", "how far a ground's mean slip is from that", low=0.0, high=0.5)
    sigma_slip: float = parameter(0.08, "1", "how much the slip varies along the way", low=0.0, high=0.5)
    slip_length: float = parameter(1.0, "m", "distance over which the slip changes", low=0.05, high=100.0)
    slip_turn_arm: float = parameter(0.3, "m", "turning by 1 rad passes so much ground", low=0.0, high=2.0)
    slip_mode_weight: float = parameter(
        0.5, "1", "share of the screws' slip mode that is taken as error of each velocity", low=0.0, high=10.0
    )
    fastest: float = parameter(
        2.0, "m/s", "ten times RM3's speed: screws that say more have a jump in their encoders", low=0.1, high=100.0
    )
    still_screw_speed: float = parameter(
        0.05, "rad/s", "all screws slower than this: the robot stands, velocity zero", low=0.0, high=10.0
    )
    sigma_still: float = parameter(0.002, "m/s, rad/s", "creep of a robot whose screws stand", low=1e-5, high=0.1)
    sigma_match: float = parameter(
        0.0001, "m", "what scan matches have in common: whiskers' errors of 1.2 mm each, averaged",
        low=0.0, high=0.1,
    )  # fmt: skip
    sigma_match_yaw_deg: float = parameter(
        0.07, "deg", "as sigma_match, over the array's half width", low=0.0, high=5.0
    )
    match_length: float = parameter(10.0, "m", "way over which that stays the same", low=0.01, high=100.0)
    tilt_time_constant: float = parameter(
        5.0, "s", "averages the specific force's noise; a BNO080's gyro drifts by 0.3 deg in it", low=0.5, high=300.0
    )
    sigma_tilt_deg: float = parameter(
        0.3, "deg", "of roll and pitch: the accelerometer's bias of 0.03 m/s2 is 0.2 deg", low=0.01, high=10.0
    )
    height_walk: float = parameter(
        0.01, "m/sqrt(m)", "how the error of z grows where the body follows uneven ground", low=0.0, high=1.0
    )
    gate: float = parameter(
        16.0, "1", "squared Mahalanobis distance (three axes) beyond which a measurement loses weight: 0.1 % by chance",
        low=3.0, high=1000.0,
    )  # fmt: skip
