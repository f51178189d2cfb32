"""From configuration, layout and calibration to a pipeline: the one place where its parts are put together."""

from __future__ import annotations

from functools import partial
from pathlib import Path
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
from robominer_slam.patch_pages import SqlitePages
from robominer_slam.pipeline import Pipeline
from robominer_slam.rest_tracking import RestTracker
from robominer_slam.slam.backend_runner import BackendRunner, SynchronousRunner, ThreadedRunner
from robominer_slam.slam.composite_scan import CompositeScan
from robominer_slam.slam.keyframe import Backend
from robominer_slam.slam.localised_backend import LocalisedBackend
from robominer_slam.slam.saved_map import SavedMap
from robominer_slam.slam.scan_odometry import ScanOdometry
from robominer_slam.slam.surface import SurfaceModel
from robominer_slam.slam.thesis import ThesisBackend
from robominer_slam.whisker_health import WhiskerHealth
from robominer_slam.whisker_monitor import WhiskerMonitor

FloatArray = NDArray[np.float64]
Execution = Literal["synchronous", "threaded"]


def build_pipeline(
    configuration: Configuration,
    layout: WhiskerLayout,
    model: PolynomialModel,
    execution: Execution,
    known: SavedMap | None = None,
    page_folder: Path | None = None,
) -> Pipeline:
    """Assemble the pipeline; `threaded` for the daemon, `synchronous` for replay; in a known map, if there is one.

    Args:
        configuration, layout, model: what it is made of.
        execution: of the back-end.
        known: the map to start in; None for a new one.
        page_folder: where a map that outgrows the memory is paged to; None for the system's temporary files.
    """
    composite, runner = build_slam(configuration, execution, known, page_folder)
    contact = configuration.contact
    pipeline = Pipeline(
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
        scan_odometry=build_scan_odometry(configuration, layout),
        points_down=points_down(layout),
        imu_mounts={
            device.name: geometry.matrix_from_rpy(np.deg2rad(device.mount_rpy_deg))
            for device in configuration.device
            if any(device.mount_rpy_deg)
        },
        reorder_window_ns=round(configuration.estimation.reorder_window * 1e9),
    )
    pipeline.localised = known is None
    return pipeline


def build_slam(
    configuration: Configuration,
    execution: Execution,
    known: SavedMap | None = None,
    page_folder: Path | None = None,
) -> tuple[CompositeScan | None, BackendRunner | None]:
    """The method's front-end and back-end, fresh or in a known map; nothing for odometry alone."""
    slam = configuration.slam
    backend: Backend
    match slam.method:
        case "none":
            return None, None
        case "thesis":
            thesis = slam.thesis
            composite = CompositeScan(thesis.keyframe_distance, thesis.keyframe_angle, thesis.scan_voxel)
            backend = ThesisBackend(thesis)
        case "robust":
            first = known.next_id if known is not None else 0
            composite = CompositeScan(slam.robust.keyframe_distance, slam.robust.keyframe_angle, 0.0, first)
            frozen = known is not None and slam.start == "localize"
            backend = LocalisedBackend(slam.robust, known, frozen, partial(SqlitePages, page_folder))
    latency_ns = round(slam.backend_latency * 1e9)
    if execution == "threaded":
        return composite, ThreadedRunner(backend, latency_ns, slam.backend_queue)
    return composite, SynchronousRunner(backend, latency_ns)


def points_down(layout: WhiskerLayout) -> NDArray[np.bool_]:
    """Whiskers that feel the floor, shape (n,): mounted within 30 degrees of straight down."""
    return np.asarray(layout.R_base_whisker[:, 2, 2] <= -np.cos(np.deg2rad(30.0)))


def build_scan_odometry(configuration: Configuration, layout: WhiskerLayout) -> ScanOdometry | None:
    """Scan matching, for the method that has it."""
    robust = configuration.slam.robust
    if configuration.slam.method != "robust" or not robust.scan_matching.enabled:
        return None
    reach = float((np.abs(layout.p_base[:, :2]).max(axis=1) + layout.length).max()) + 0.1
    return ScanOdometry(robust.scan_matching, SurfaceModel.of(robust.surface), reach)


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
