"""What the simulated robot looks like in its world, rendered by MuJoCo without a window."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING

import matplotlib
import mujoco
import numpy as np
from numpy.typing import NDArray

from robominer_slam.layout import WhiskerLayout
from sim_backend.scene import World, WorldError
from sim_backend.view_heights import ViewHeights

if TYPE_CHECKING:
    from mujoco.egl import GLContext

# PyOpenGL tells at level INFO which accelerators it lacks.
logging.getLogger("OpenGL").setLevel(logging.WARNING)

FloatArray = NDArray[np.float64]
Image = NDArray[np.uint8]

#: Inclinations over which the colour of a touching whisker runs, rad.
STEEPEST = np.deg2rad(75.0)
ROD_COLOURS = "plasma"
FREE_ROD = np.array([0.85, 0.85, 0.85, 1.0], dtype=np.float32)
#: Rods are drawn thicker than they are, m, to be seen at all.
ROD_RADIUS = 0.0025
CONTACT_RADIUS = 0.005
BODY = np.array([0.25, 0.45, 0.65, 0.3], dtype=np.float32)
AHEAD = np.array([0.1, 0.1, 0.1, 1.0], dtype=np.float32)
FLOW = np.array([0.1, 0.75, 0.95, 0.8], dtype=np.float32)
#: Metres of arrow per m/s of flow.
FLOW_SCALE = 0.25
#: The ground's colours are a picture of this many pixels a side.
TEXTURE = 1024
MOST_SHAPES = 2000


class SceneView:
    """A world and a robot to be drawn again and again."""

    def __init__(self, world: World, layout: WhiskerLayout, heights: ViewHeights, size: tuple[int, int]) -> None:
        """Prepare the scene.

        Args:
            world: its solids are drawn as they are, its ground and walls as `heights`.
            layout: of the array.
            heights: of the part of the world that is shown.
            size: of the picture, width and height, pixels.

        Raises:
            WorldError: this machine cannot render (no OpenGL).
        """
        self.layout, self.world = layout, world
        self._model = _scenery(world, heights, size)
        self._data = mujoco.MjData(self._model)
        mujoco.mj_forward(self._model, self._data)
        self._context = _off_screen(*size)
        self._mjr = mujoco.MjrContext(self._model, mujoco.mjtFontScale.mjFONTSCALE_100.value)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self._mjr)
        self._scene = mujoco.MjvScene(self._model, maxgeom=MOST_SHAPES)
        self._options = mujoco.MjvOption()
        self._size = size
        self._colours = matplotlib.colormaps[ROD_COLOURS]

    def close(self) -> None:
        """Free the graphics memory."""
        self._mjr.free()
        self._context.free()

    def render(
        self,
        position: FloatArray,
        R: FloatArray,
        tips: FloatArray,
        inclination: FloatArray,
        contact: NDArray[np.bool_],
        *,
        distance: float = 1.1,
        azimuth: float = 130.0,
        elevation: float = -28.0,
        flow: tuple[FloatArray, FloatArray] | None = None,
    ) -> Image:
        """A picture, shape (height, width, 3).

        Args:
            position, R: of base_link in the map, shapes (3,), m, and (3, 3).
            tips: ends of the rods in the map, shape (n, 3), m.
            inclination: of the rods, shape (n,), rad.
            contact: which of them touch, shape (n,).
            distance, azimuth, elevation: of the camera, looking at the robot, m and deg.
            flow: places and velocities of water, shapes (m, 3), m and m/s.
        """
        camera = mujoco.MjvCamera()
        camera.lookat[:] = position + np.array([0.0, 0.0, -0.05])
        camera.distance, camera.azimuth, camera.elevation = distance, azimuth, elevation
        everything = mujoco.mjtCatBit.mjCAT_ALL.value
        mujoco.mjv_updateScene(self._model, self._data, self._options, None, camera, everything, self._scene)
        self._draw_body(position, R)
        mounts = position + self.layout.p_base @ R.T
        colours = self._colours(np.clip(inclination / STEEPEST, 0.0, 1.0)).astype(np.float32)
        for i in np.flatnonzero(self.layout.present):
            self._connect(mounts[i], tips[i], colours[i] if contact[i] else FREE_ROD)
            if contact[i]:
                self._add(mujoco.mjtGeom.mjGEOM_SPHERE, [CONTACT_RADIUS, 0, 0], tips[i], np.eye(3), colours[i])
        if flow is not None:
            for place, velocity in zip(*flow, strict=True):
                self._connect(place, place + FLOW_SCALE * velocity, FLOW, mujoco.mjtGeom.mjGEOM_ARROW, 0.006)
        image: Image = np.empty((self._size[1], self._size[0], 3), dtype=np.uint8)
        self._context.make_current()
        view = mujoco.MjrRect(0, 0, *self._size)
        mujoco.mjr_render(view, self._scene, self._mjr)
        mujoco.mjr_readPixels(image, None, view, self._mjr)
        return image[::-1]

    def _draw_body(self, position: FloatArray, R: FloatArray) -> None:
        """A plate with the rods' mounts on its underside, and an arrow ahead."""
        low, high = self.layout.p_base.min(axis=0), self.layout.p_base.max(axis=0)
        half, middle = (high - low) / 2.0 + 0.01, (high + low) / 2.0
        middle[2] += half[2]
        self._add(mujoco.mjtGeom.mjGEOM_BOX, half, position + R @ middle, R, BODY)
        nose = position + R @ np.array([high[0] + 0.01, 0.0, middle[2]])
        self._connect(nose, nose + R @ np.array([0.1, 0.0, 0.0]), AHEAD, mujoco.mjtGeom.mjGEOM_ARROW, 0.01)

    def _connect(
        self,
        start: FloatArray,
        end: FloatArray,
        rgba: NDArray[np.float32],
        kind: mujoco.mjtGeom = mujoco.mjtGeom.mjGEOM_CAPSULE,
        radius: float = ROD_RADIUS,
    ) -> None:
        geom = self._add(kind, [0, 0, 0], np.zeros(3), np.eye(3), rgba)
        mujoco.mjv_connector(geom, kind, radius, start, end)

    def _add(
        self,
        kind: mujoco.mjtGeom,
        size: FloatArray | list[float],
        position: FloatArray,
        R: FloatArray,
        rgba: NDArray[np.float32],
    ) -> mujoco.MjvGeom:
        scene = self._scene
        if scene.ngeom >= scene.maxgeom:
            raise ValueError(f"a picture holds at most {scene.maxgeom} shapes")
        geom = scene.geoms[scene.ngeom]
        mujoco.mjv_initGeom(geom, kind, np.asarray(size, dtype=np.float64), position, R.ravel(), rgba)
        scene.ngeom += 1
        return geom


def _off_screen(width: int, height: int) -> GLContext:
    """An OpenGL context that needs no display, made current.

    Raises:
        WorldError: there is none on this machine.
    """
    try:
        from mujoco.egl import GLContext

        context = GLContext(width, height)
        context.make_current()
    except (ImportError, AttributeError, OSError, RuntimeError) as error:
        raise WorldError(
            f"pictures need OpenGL through EGL, found none ({error}): install libegl1 and libgl1-mesa-dri"
        ) from error
    return context


def _scenery(world: World, heights: ViewHeights, size: tuple[int, int]) -> mujoco.MjModel:
    """Ground (and walls, cut open) as a coloured height field, objects as they are."""
    z = heights.z
    low, high = float(z.min()), float(z.max())
    (x0, x1), (y0, y1) = heights.extent
    solids = "".join(
        f'<geom type="{s.shape}" size="{_text(s.size)}" pos="{_text(s.centre)}" quat="{_text(s.quaternion_wxyz())}" '
        f'rgba="0.45 0.55 0.5 1"/>'
        for s in world.solids
    )
    model = mujoco.MjModel.from_xml_string(
        f"""<mujoco>
        <visual><global offwidth="{size[0]}" offheight="{size[1]}"/><map znear="0.005" zfar="60"/>
        <headlight ambient="0.45 0.45 0.45" diffuse="0.35 0.35 0.35" specular="0 0 0"/></visual>
        <asset>
        <hfield name="ground" nrow="{z.shape[0]}" ncol="{z.shape[1]}"
          size="{(x1 - x0) / 2} {(y1 - y0) / 2} {max(high - low, 1e-6)} 0.05"/>
        <texture name="sky" type="skybox" builtin="flat" rgb1="1 1 1" rgb2="1 1 1" width="32" height="32"/>
        <texture name="heights" type="2d" builtin="flat" width="{TEXTURE}" height="{TEXTURE}"/>
        <material name="heights" texture="heights" specular="0" shininess="0" reflectance="0"/>
        </asset>
        <worldbody>
        <light pos="{(x0 + x1) / 2 - 1} {(y0 + y1) / 2 - 1} 3" dir="0.3 0.3 -1" directional="true"
          diffuse="0.5 0.5 0.5" castshadow="true"/>
        <geom type="hfield" hfield="ground" material="heights" pos="{(x0 + x1) / 2} {(y0 + y1) / 2} {low}"/>
        {solids}
        </worldbody></mujoco>"""
    )
    model.hfield_data[:] = ((z - low) / max(high - low, 1e-6)).ravel()
    colours = heights.greys(TEXTURE)[::-1]  # a texture's first row is its top
    first = model.tex_adr[mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_TEXTURE, "heights")]
    model.tex_data[first : first + colours.size] = colours.ravel()
    return model


def _text(values: FloatArray | tuple[float, ...]) -> str:
    return " ".join(repr(float(value)) for value in values)
