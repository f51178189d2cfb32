"""Pictures of a simulated drive: the robot in its world, beside the map from above; still, or as an animation."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from types import TracebackType

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray
from PIL import Image as PillowImage

from robominer_slam import layout as layouts
from sim_backend.engines import base_motion_on, build_engine
from sim_backend.physics import ArrayReading, rod_direction
from sim_backend.scene import World
from sim_backend.scene_view import ROD_COLOURS, STEEPEST, SceneView
from sim_backend.touch_surface import Extent
from sim_backend.view_heights import CUT_Z, ViewHeights
from sim_backend.waypoints import WaypointPath

FloatArray = NDArray[np.float64]

#: A drive of the quasi-static engine can be looked at every so often, s.
INTERVAL = 0.04
#: Of so many frames one is drawn on the map.
THINNED = 5
#: Time that an animation shows each picture, ms.
FRAME_MS = 130
#: Half a side of the ground that is drawn around a robot in a world that is larger than this, m.
SURROUNDINGS = 4.0
#: Arrows of flow are drawn this far around the robot, m.
FLOW_AROUND = 0.45
#: Of heights on the map; safe for the colour-blind.
HEIGHT_COLOURS = "cividis"
PATH_COLOUR, CONTACT_COLOUR, ROBOT_COLOUR = "#0072b2", "#d55e00", "#000000"


@dataclass(frozen=True)
class Snapshot:
    """The robot at one instant of its drive.

    Attributes:
        time: s.
        position, R: of base_link in the map, shapes (3,), m, and (3, 3).
        tips: shape (n, 3), m, map frame.
        reading: the array's.
        driven: places of base_link so far, shape (m, 2), m.
        touched: contacts so far, shape (k, 2), m; thinned.
    """

    time: float
    position: FloatArray
    R: FloatArray
    tips: FloatArray
    reading: ArrayReading
    driven: FloatArray = field(repr=False)
    touched: FloatArray = field(repr=False)


def drive(world: World, scenario: int, engine: str, times: FloatArray) -> Iterator[Snapshot]:
    """Drive a scenario and stop at the given times, increasing, s.

    Raises:
        WorldError: no such scenario, or the engine cannot do this world.
    """
    layout = layouts.BUILT_IN[world.layout]()
    motion = base_motion_on(world, WaypointPath(world.scenario(scenario)))
    offset = np.zeros(layout.count)
    array = build_engine(engine, world, layout, motion, read_offset=offset, interval=INTERVAL)
    driven: list[FloatArray] = []
    touched: list[FloatArray] = []
    wanted = np.rint(np.asarray(times) / INTERVAL).astype(np.int64)
    frame = -1
    for number in wanted:
        while frame < number:
            reading = array.read()
            frame += 1
            base = motion.at([frame * INTERVAL])
            rods = np.einsum("nij,nj->ni", layout.R_base_whisker, rod_direction(reading.hinge))
            tips = base.position[0] + (layout.p_base + layout.length[:, None] * rods) @ base.R[0].T
            if frame % THINNED == 0:
                driven.append(base.position[0, :2])
                touched.append(tips[reading.contact][:, :2])
        yield Snapshot(
            frame * INTERVAL,
            base.position[0],
            base.R[0],
            tips,
            reading,
            np.array(driven).reshape(-1, 2),
            np.concatenate(touched) if touched else np.empty((0, 2)),
        )


def write_picture(world: World, scenario: int, engine: str, time: float, path: Path, *, width: int = 1500) -> None:
    """Write a PNG of the robot in its world `time` seconds into a scenario.

    Raises:
        WorldError: no such scenario, this machine cannot render, or the engine cannot do this world.
        OSError: the file cannot be written.
    """
    (snapshot,) = drive(world, scenario, engine, np.array([time]))
    with Composer(world, scenario, width) as composer:
        composer.compose(snapshot).save(path)


def write_animation(
    world: World,
    scenario: int,
    engine: str,
    path: Path,
    *,
    frames: int = 60,
    width: int = 900,
    on_progress: Callable[[float], None] | None = None,
) -> None:
    """Write a WebP or a GIF, three times as large, of a whole scenario, looked at `frames` times.

    Raises:
        WorldError: no such scenario, this machine cannot render, or the engine cannot do this world.
        OSError: the file cannot be written.
    """
    duration = WaypointPath(world.scenario(scenario)).duration
    pictures = []
    with Composer(world, scenario, width) as composer:
        for k, snapshot in enumerate(drive(world, scenario, engine, np.linspace(1.0, duration - 0.1, frames))):
            pictures.append(composer.compose(snapshot))
            if on_progress is not None:
                on_progress((k + 1) / frames)
    if path.suffix == ".gif":
        pictures = [picture.quantize(128, dither=PillowImage.Dither.NONE) for picture in pictures]
    pictures[0].save(path, save_all=True, append_images=pictures[1:], duration=FRAME_MS, loop=0, quality=70)


class Composer:
    """Joins the rendered robot and the map from above to one picture."""

    def __init__(self, world: World, scenario: int, width: int) -> None:
        self.world, self.scenario = world, scenario
        self.layout = layouts.BUILT_IN[world.layout]()
        self.waypoints = world.scenario(scenario)
        self.width, self.height = width, round(width * 0.42)
        self._map = ViewHeights.of(world, _shown(world, self.waypoints), 700)
        self._view: SceneView | None = None
        self._middle = np.zeros(2)

    def __enter__(self) -> Composer:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._view is not None:
            self._view.close()

    def compose(self, snapshot: Snapshot) -> PillowImage.Image:
        """One picture."""
        dpi = 100.0 * self.width / 1500.0
        figure = Figure(figsize=(self.width / dpi, self.height / dpi), dpi=dpi, layout="constrained")
        left, right = figure.subplots(1, 2, width_ratios=[1.25, 1.0])
        left.imshow(self._rendered(snapshot))
        left.set_axis_off()
        left.set_title(f"world {self.world.name}, scenario {self.scenario}, {snapshot.time:.0f} s", fontsize=11)
        rods = matplotlib.cm.ScalarMappable(
            matplotlib.colors.Normalize(0.0, np.rad2deg(STEEPEST)), matplotlib.colormaps[ROD_COLOURS]
        )
        bar = figure.colorbar(rods, ax=left, orientation="horizontal", fraction=0.05, aspect=45, pad=0.02)
        bar.set_label("inclination of touching whiskers (deg); free ones are grey", fontsize=9)
        self._draw_map(figure, right, snapshot)
        encoded = BytesIO()
        figure.savefig(encoded, format="png", dpi=dpi)
        return PillowImage.open(encoded).convert("RGB")

    def _rendered(self, snapshot: Snapshot) -> NDArray[np.uint8]:
        heading = float(np.rad2deg(np.arctan2(snapshot.R[1, 0], snapshot.R[0, 0])))
        underground = self.world.walls is not None
        return self._view_around(snapshot.position).render(
            snapshot.position,
            snapshot.R,
            snapshot.tips,
            snapshot.reading.inclination,
            snapshot.reading.contact,
            distance=1.8 if underground else 0.95,
            # From behind on the right, so that the way ahead is seen.
            azimuth=heading + (20.0 if underground else 40.0),
            elevation=-52.0 if underground else -17.0,
            flow=self._flow(snapshot),
        )

    def _flow(self, snapshot: Snapshot) -> tuple[FloatArray, FloatArray] | None:
        """Water's velocity at places around the robot, for arrows."""
        water = self.world.water
        if water is None:
            return None
        offset = np.linspace(-FLOW_AROUND, FLOW_AROUND, 4)
        x, y = (snapshot.position[axis] + grid.ravel() for axis, grid in enumerate(np.meshgrid(offset, offset)))
        places = np.column_stack([x, y, np.full(x.size, snapshot.position[2] - 0.06)])
        return places, water.current.at(np.full(x.size, snapshot.time), x, y)

    def _view_around(self, position: FloatArray) -> SceneView:
        """The view of the ground around a place; a new one only where the robot has left the last."""
        if self._view is not None and np.abs(position[:2] - self._middle).max() < SURROUNDINGS / 2.0:
            return self._view
        if self._view is not None:
            self._view.close()
        (x0, x1), (y0, y1) = self._map.extent
        x, y = self._middle = position[:2].copy()
        near = (
            (max(x0, x - SURROUNDINGS), min(x1, x + SURROUNDINGS)),
            (max(y0, y - SURROUNDINGS), min(y1, y + SURROUNDINGS)),
        )
        size = (round(self.width * 0.52), round(self.height * 0.82))
        self._view = SceneView(self.world, self.layout, ViewHeights.of(self.world, near, 900), size)
        return self._view

    def _draw_map(self, figure: Figure, axes: Axes, snapshot: Snapshot) -> None:
        (x0, x1), (y0, y1) = self._map.extent
        px, py = np.meshgrid(np.linspace(x0, x1, self._map.z.shape[1]), np.linspace(y0, y1, self._map.z.shape[0]))
        z = np.where(self._map.rock, np.nan, self._map.z if self._map.rock.any() else self.world.height(px, py))
        axes.set_facecolor("#46423e")
        image = axes.imshow(
            z, origin="lower", extent=(x0, x1, y0, y1), cmap=HEIGHT_COLOURS, vmax=min(float(np.nanmax(z)), CUT_Z)
        )
        figure.colorbar(image, ax=axes, orientation="horizontal", fraction=0.05, aspect=40).set_label(
            "height (m)", fontsize=9
        )
        axes.plot(*self.waypoints[:, :2].T, ":", color="grey", linewidth=1.2, label="way planned")
        axes.plot(*snapshot.touched.T, ",", color=CONTACT_COLOUR, alpha=0.6)
        axes.plot([], [], ".", color=CONTACT_COLOUR, label="touched")
        axes.plot(*snapshot.driven.T, "-", color=PATH_COLOUR, linewidth=1.5, label="driven")
        low, high = self.layout.p_base[:, :2].min(axis=0), self.layout.p_base[:, :2].max(axis=0)
        corners = np.array(
            [[low[0], low[1]], [high[0], low[1]], [high[0], high[1]], [low[0], high[1]], [low[0], low[1]]]
        )
        outline = snapshot.position[:2] + corners @ snapshot.R[:2, :2].T
        axes.plot(*outline.T, "-", color=ROBOT_COLOUR, linewidth=1.3, label="robot")
        nose = snapshot.position[:2] + snapshot.R[:2, 0] * (high[0] + 0.12)
        axes.plot(
            [snapshot.position[0], nose[0]], [snapshot.position[1], nose[1]], "-", color=ROBOT_COLOUR, linewidth=1.3
        )
        axes.set_xlabel("x (m)")
        axes.set_ylabel("y (m)")
        figure.legend(*axes.get_legend_handles_labels(), loc="outside upper right", ncols=4, fontsize=9, frameon=False)


def _shown(world: World, waypoints: FloatArray) -> Extent:
    """What of the world the scenario passes, and 0.7 m around."""
    low, high = waypoints[:, :2].min(axis=0) - 0.7, waypoints[:, :2].max(axis=0) + 0.7
    if world.walls is None:
        (x0, x1), (y0, y1) = world.ground.extent
        low, high = np.maximum(low, [x0, y0]), np.minimum(high, [x1, y1])
    return (float(low[0]), float(high[0])), (float(low[1]), float(high[1]))
