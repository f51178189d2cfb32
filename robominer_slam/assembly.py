"""From configuration, layout and calibration to a pipeline: the one place where its parts are put together."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray

from calibration.angle_estimator import AngleEstimator
from calibration.polynomial import PolynomialModel
from robominer_slam import geometry
from robominer_slam.configuration.model import Configuration
from robominer_slam.contacts import ContactModel
from robominer_slam.estimation.drag_direction import DragDirection
from robominer_slam.estimation.fused_odometry import FusedOdometry
from robominer_slam.estimation.integrated_odometry import IntegratedOdometry
from robominer_slam.estimation.odometry_state import DeadReckoning
from robominer_slam.estimation.robust_odometry import RobustOdometry
from robominer_slam.estimation.screw_kinematics import forward_matrix
from robominer_slam.flow_bend import FlowBend
from robominer_slam.layout import WhiskerLayout
from robominer_slam.pipeline import Pipeline
from robominer_slam.rest_tracking import RestTracker
from robominer_slam.slam.backend_runner import BackendRunner, SynchronousRunner, ThreadedRunner
from robominer_slam.slam.composite_scan import CompositeScan
from robominer_slam.slam.thesis import ThesisBackend
from robominer_slam.whisker_health import WhiskerHealth
from robominer_slam.whisker_monitor import WhiskerMonitor

FloatArray = NDArray[np.float64]
Execution = Literal["synchronous", "threaded"]


def build_pipeline(
    configuration: Configuration, layout: WhiskerLayout, model: PolynomialModel, execution: Execution
) -> Pipeline:
    """Assemble the pipeline; `threaded` for the daemon, `synchronous` for replay."""
    composite, runner = build_slam(configuration, execution)
    contact = configuration.contact
    return Pipeline(
        dead_reckoning=_dead_reckoning(configuration, layout),
        angle_estimator=AngleEstimator(model),
        monitor=WhiskerMonitor(
            WhiskerHealth(configuration.health, layout, model.rest_mT, model.fitted, folded=model.folded),
            RestTracker(configuration.health, layout),
            FlowBend(contact, layout),
        ),
        contact_model=ContactModel(
            layout, np.deg2rad(contact.min_inclination_deg), np.deg2rad(contact.max_inclination_deg)
        ),
        composite_scan=composite,
        runner=runner,
        imu_mounts={
            device.name: geometry.matrix_from_rpy(np.deg2rad(device.mount_rpy_deg))
            for device in configuration.device
            if any(device.mount_rpy_deg)
        },
        reorder_window_ns=round(configuration.estimation.reorder_window * 1e9),
    )


def build_slam(configuration: Configuration, execution: Execution) -> tuple[CompositeScan | None, BackendRunner | None]:
    """The method's front-end and back-end, fresh; nothing for odometry alone."""
    slam = configuration.slam
    if slam.method != "thesis":
        return None, None
    thesis = slam.thesis
    composite = CompositeScan(thesis.keyframe_distance, thesis.keyframe_angle, thesis.scan_voxel)
    backend = ThesisBackend(thesis)
    latency_ns = round(slam.backend_latency * 1e9)
    if execution == "threaded":
        return composite, ThreadedRunner(backend, latency_ns, slam.backend_queue)
    return composite, SynchronousRunner(backend, latency_ns)


def build_robust_odometry(configuration: Configuration, layout: WhiskerLayout) -> RobustOdometry:
    """The dead reckoning of the method `robust`, at its start."""
    settings = configuration.robust_estimation
    drag = DragDirection(settings, layout) if settings.drag else None
    return RobustOdometry(settings, configuration.estimation.source, drag, _screw_matrix(configuration))


def _dead_reckoning(configuration: Configuration, layout: WhiskerLayout) -> DeadReckoning:
    if configuration.slam.method == "robust":
        return build_robust_odometry(configuration, layout)
    if configuration.estimation.source == "odometry":
        return IntegratedOdometry()
    return FusedOdometry(configuration.estimation, _screw_matrix(configuration))


def _screw_matrix(configuration: Configuration) -> FloatArray:
    screws = configuration.screws
    return forward_matrix(screws.radius, np.deg2rad(screws.helix_angle_deg), screws.half_track, screws.half_base)
