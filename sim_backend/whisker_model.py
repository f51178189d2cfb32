"""The whisker array as a MuJoCo model: rods on two hinges each, over ground and objects.

Every parameter of the mechanics and of the contacts is here, with its reason.
"""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from robominer_slam.layout import WhiskerLayout
from sim_backend.ground_contacts import RIDGE_RADIUS
from sim_backend.world import World

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class WhiskerMechanics:
    """Rod and joint of a whisker.

    Attributes:
        mass: of the rod, kg (the thesis's 8 g; a steel rod of 3 mm by 150 mm has 8.3 g).
        radius: of the rod, m.
        stiffness: of both hinges, N m/rad. The thesis's 5.7 is N/rad; times the lever between rod and membrane
            (some millimetres to a centimetre) it is 0.03 to 0.1 N m/rad.
        damping_ratio: zeta of the free oscillation; 0.47 is the thesis's logarithmic decrement of 3.35.
        hinge_damping: of both hinges, N m s/rad, where it is known; None takes it from the ratio.
    """

    mass: float = 0.008
    radius: float = 0.0015
    stiffness: float = 0.1
    damping_ratio: float = 0.47
    hinge_damping: float | None = None

    def inertia(self, length: float) -> float:
        """Moment of inertia of a rod about its joint, kg m2."""
        return self.mass * length**2 / 3.0

    def damping(self, length: float) -> float:
        """Viscous damping of a hinge, c = 2 zeta sqrt(I k) unless given, N m s/rad."""
        if self.hinge_damping is not None:
            return self.hinge_damping
        return 2.0 * self.damping_ratio * float(np.sqrt(self.inertia(length) * self.stiffness))

    def stepped(self, length: float, time_step: float) -> tuple[float, float]:
        """Inertia (kg m2) and damping (N m s/rad) with which a free rod moves as it should in spite of the time step.

        The integrator takes damping at the step's end and the spring at its beginning: a free hinge then follows
        I (z - 1)^2 + h c (z - 1) z + h^2 k z = 0 per step h. Where the rod swings, these are the I and c that have the
        poles z = exp(s h) of the true swing: frequency and decrement are right, and so is the static deflection, as
        k is kept. An overdamped rod's fast pole would ask for no inertia at all: c alone makes its slow pole right.
        """
        inertia, damping, h, k = self.inertia(length), self.damping(length), time_step, self.stiffness
        square = damping**2 - 4.0 * inertia * k
        if square >= 0.0:
            z = float(np.exp((np.sqrt(square) - damping) / (2.0 * inertia) * h))
            return inertia, inertia * (1.0 - z) / (h * z) + h * k / (1.0 - z)
        pole = np.exp(complex(-damping, np.sqrt(-square)) / (2.0 * inertia) * h)
        total = h**2 * k / float(abs(1.0 - pole)) ** 2  # I + h c
        stepped_inertia = float(abs(pole)) ** 2 * total
        return stepped_inertia, (total - stepped_inertia) / h


#: The joint as the thesis entered it into its simulator, 5.7 N m/rad and 0.1 N m s/rad: a free rod is overdamped and
#: creeps back with c / k = 18 ms. Such joints press 57 times as hard as the measured ones and the soft contacts give
#: way: touching rods are 3.4 mm deep in the thesis's ground in the median and 8 mm at 95 % (tunnel: 2.2 and 3.5 mm),
#: against 0 and 0.2 mm with the default. For comparison with the thesis only, not for maps.
THESIS_LITERAL = WhiskerMechanics(stiffness=5.7, hinge_damping=0.1)
#: Joints by the name that the command line has for them.
JOINTS = {"default": WhiskerMechanics(), "thesis-literal": THESIS_LITERAL}


@dataclass(frozen=True, slots=True)
class ContactModel:
    """Contacts of the rods with ground and objects.

    A soft-contact engine has two ways to spoil a map. Rods sink in when the contact is soft. And they chatter
    when it is hard: MuJoCo's convex friction cone lifts a sliding contact by friction * b / k * speed (b, k:
    damping and stiffness of the contact), the contact is lost for a step, and the bent rod shoots 2 to 4 mm deep.
    Three things together prevent both: a friction reference slower than the normal one keeps the lift small;
    an impedance that starts at 0.8 keeps some pressed-in depth in hand, so that the contact holds on convex
    ground; `margin` puts that depth above the surface instead of below it.

    Attributes:
        time_constant: of the normal direction, s; at least twice the time step.
        friction_time_constant: of the tangential directions, s.
        friction: Coulomb's coefficient, a rounded steel tip on rock. The driver's reversals turn rods over: those
            steeper than atan(friction) jam instead.
        impedance: MuJoCo's solimp d0, dwidth, width.
        margin: thickness of the layer in which a contact's force builds up, m.
        cone_ratio: MuJoCo's impratio; 3 lets sliding reach Coulomb's limit in spite of the slow reference.
    """

    time_constant: float = 0.008
    friction_time_constant: float = 0.04
    friction: float = 0.3
    impedance: tuple[float, float, float] = (0.8, 0.95, 0.002)
    margin: float = 0.0004
    cone_ratio: float = 3.0


#: Each whisker hangs on a body of its own that is moved as the grid moves. Its mass, kg and kg m2, is so large
#: that no contact moves it between two steps. One common body would couple all whiskers in the contact solver,
#: which makes a step two to three times slower.
CARRIER_MASS = 100.0
GEOM_PREFIX = "whisker"
#: Planes and ridges, the mocap bodies in the order of `GroundContacts`.
GROUND_PREFIX = "ground_under_"


def build(
    world: World,
    layout: WhiskerLayout,
    mechanics: WhiskerMechanics,
    contact: ContactModel,
    time_step: float,
    parts: int = 1,
) -> mujoco.MjModel:
    """The compiled model.

    Joints: for each whisker a free joint, then the hinges about its x and y axes. Mocap bodies: what each whisker
    can touch of the ground, or of floor and walls, `parts` planes and a ridge (`ground_contacts`). Ground, objects
    and other rods act on all of a rod. The height field itself is only there to be looked at: MuJoCo collides with
    the prisms of its cells one by one, and a rod that a reversal pressed deeper than the distance to a prism's side
    is then held there, by contacts that push sideways, for good.
    """
    solids = _solids(world)
    whiskers = [_whisker(i, layout, mechanics, time_step) for i in range(layout.count)]
    solref = f"{contact.time_constant} 1"
    parameters = (
        f'condim="3" friction="{contact.friction} {contact.friction} 0.005 0.0001 0.0001" solref="{solref}" '
        f'solreffriction="{contact.friction_time_constant} 1" margin="{contact.margin}" '
        f'solimp="{" ".join(map(str, contact.impedance))}"'
    )
    pairs = [
        f'<pair geom1="{other}" geom2="{GEOM_PREFIX}{i}" {parameters}/>'
        for i in np.flatnonzero(layout.present)
        for other in (
            *(f"{GROUND_PREFIX}{k * layout.count + i}" for k in range(parts + 1)),
            *(solid.name for solid in world.solids),
        )
    ]
    shapes = ['type="plane" size="0.01 0.01 0.01"'] * parts + [f'type="sphere" size="{RIDGE_RADIUS}"']
    planes = [
        f'<body mocap="true" pos="0 0 -10"><geom name="{GROUND_PREFIX}{k * layout.count + i}" {shape} '
        f'contype="0" conaffinity="0" rgba="0 0 0 0"/></body>'
        for k, shape in enumerate(shapes)
        for i in range(layout.count)
    ]
    ny, nx = world.ground.z.shape
    (x0, x1), (y0, y1) = world.ground.extent
    z = world.ground.height(*np.meshgrid(np.linspace(x0, x1, nx), np.linspace(y0, y1, ny)))
    low, high = float(z.min()), float(z.max())
    size = f"{(x1 - x0) / 2} {(y1 - y0) / 2} {max(high - low, 1e-6)} 0.1"
    model = mujoco.MjModel.from_xml_string(
        f"""<mujoco model="{world.name}">
        <option timestep="{time_step}" integrator="implicitfast" solver="CG" cone="elliptic" jacobian="sparse"
          impratio="{contact.cone_ratio}" tolerance="1e-6"/>
        <size memory="64M"/>
        <visual><global offwidth="1600" offheight="900"/></visual>
        <default><geom solref="{solref}"/></default>
        <asset><hfield name="ground" nrow="{ny}" ncol="{nx}" size="{size}"/></asset>
        <worldbody>
        <light pos="1.5 0.5 3" dir="0 0.2 -1" castshadow="true"/>
        <geom name="ground" type="hfield" hfield="ground" pos="{(x0 + x1) / 2} {(y0 + y1) / 2} {low}"
          contype="0" conaffinity="0" rgba="0.62 0.55 0.45 1"/>
        {"".join(solids)}{"".join(planes)}{"".join(whiskers)}
        </worldbody>
        <contact>{"".join(pairs)}</contact></mujoco>"""
    )
    model.hfield_data[:] = ((z - low) / max(high - low, 1e-6)).ravel()
    return model


def _solids(world: World) -> list[str]:
    return [
        f'<geom name="{s.name}" type="{s.shape}" size="{_text(s.size)}" pos="{_text(s.centre)}" '
        f'quat="{_text(s.quaternion_wxyz())}" contype="0" conaffinity="0" rgba="0.45 0.42 0.5 1"/>'
        for s in world.solids
    ]


def _whisker(i: int, layout: WhiskerLayout, mechanics: WhiskerMechanics, time_step: float) -> str:
    """One rod: whiskers touch each other without friction, ground and objects only through the explicit pairs."""
    length = float(layout.length[i])
    inertia, damping = mechanics.stepped(length, time_step)
    hinge = f'type="hinge" stiffness="{mechanics.stiffness}" damping="{damping}"'
    quat = np.roll(Rotation.from_matrix(layout.R_base_whisker[i]).as_quat(), 1)
    # About the middle of the rod, by Steiner.
    across, along = inertia - mechanics.mass * length**2 / 4.0, mechanics.mass * mechanics.radius**2 / 2.0
    carrier = f'mass="{CARRIER_MASS}" diaginertia="{CARRIER_MASS} {CARRIER_MASS} {CARRIER_MASS}"'
    mask = int(layout.present[i])
    return (
        f'<body pos="{_text(layout.p_base[i])}" quat="{_text(quat)}" gravcomp="1"><freejoint/>'
        f'<inertial pos="0 0 0" {carrier}/><body><joint axis="1 0 0" {hinge}/><joint axis="0 1 0" {hinge}/>'
        f'<inertial pos="0 0 {length / 2}" mass="{mechanics.mass}" diaginertia="{across} {across} {along}"/>'
        f'<geom name="{GEOM_PREFIX}{i}" type="capsule" fromto="0 0 0.002 0 0 {length - mechanics.radius}" '
        f'size="{mechanics.radius}" condim="1" contype="{mask}" conaffinity="{mask}" rgba="0.8 0.8 0.85 1"/>'
        f"</body></body>"
    )


def _text(values: FloatArray | tuple[float, ...]) -> str:
    return " ".join(repr(float(value)) for value in values)
