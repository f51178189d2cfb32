// The robot where it is: body, heading, whiskers as they bend, what they touch, and how sure the place is.
import { THREE } from "nicegui-scene";

/** Half axes of the ellipse that holds the place with 95 %, in standard deviations. */
const ELLIPSE_SIGMAS = 2.448;
const ELLIPSE_POINTS = 64;
/** A larger ellipse says no more, m. */
const LARGEST_ELLIPSE = 50;

export class RobotModel {
  constructor() {
    this.group = new THREE.Group();
    this.group.visible = false;
    this.body = new THREE.Group();
    this.group.add(this.body);
    const circle = [];
    for (let k = 0; k < ELLIPSE_POINTS; k++) {
      const angle = (2 * Math.PI * k) / ELLIPSE_POINTS;
      circle.push(new THREE.Vector3(Math.cos(angle), Math.sin(angle), 0));
    }
    this.ellipse = new THREE.LineLoop(new THREE.BufferGeometry().setFromPoints(circle), new THREE.LineBasicMaterial());
    this.ellipse.visible = false;
    this.colours = {};
    this.faults = {};
  }

  setColours(colours) {
    this.colours = Object.fromEntries(Object.entries(colours).map(([name, value]) => [name, new THREE.Color(value)]));
    this.ellipse.material.color = this.colours.ellipse;
    this.shell?.material.color.copy(this.colours.body);
    this.frame?.material.color.copy(this.colours.body);
    this.arrow?.material.color.copy(this.colours.ellipse);
    if (this.live) this.bend(this.live);
  }

  setArray(array) {
    this.array = array;
    this.body.clear();
    const bases = array.base.filter((_, k) => array.present[k]).map((p) => new THREE.Vector3(...p));
    const box = new THREE.Box3().setFromPoints(bases);
    box.expandByVector(new THREE.Vector3(0.04, 0.04, 0.02));
    const size = box.getSize(new THREE.Vector3());
    const middle = box.getCenter(new THREE.Vector3());
    const shape = new THREE.BoxGeometry(size.x, size.y, size.z);
    this.shell = new THREE.Mesh(shape, new THREE.MeshBasicMaterial({ transparent: true, opacity: 0.16, depthWrite: false }));
    this.frame = new THREE.LineSegments(new THREE.EdgesGeometry(shape), new THREE.LineBasicMaterial());
    this.arrow = new THREE.Mesh(new THREE.ConeGeometry(0.05, 0.13, 16), new THREE.MeshBasicMaterial());
    this.arrow.rotation.z = -Math.PI / 2;
    this.arrow.position.set(box.max.x + 0.08, middle.y, middle.z);
    for (const part of [this.shell, this.frame]) part.position.copy(middle);

    const count = array.base.length;
    const rods = new THREE.BufferGeometry();
    rods.setAttribute("position", new THREE.BufferAttribute(new Float32Array(6 * count), 3));
    rods.setAttribute("color", new THREE.BufferAttribute(new Float32Array(6 * count), 3));
    this.rods = new THREE.LineSegments(rods, new THREE.LineBasicMaterial({ vertexColors: true }));
    const tips = new THREE.BufferGeometry();
    tips.setAttribute("position", new THREE.BufferAttribute(new Float32Array(3 * count), 3));
    this.tips = new THREE.Points(tips, new THREE.PointsMaterial({ size: 7, sizeAttenuation: false }));
    this.rods.frustumCulled = this.tips.frustumCulled = false;
    this.body.add(this.shell, this.frame, this.arrow, this.rods, this.tips);
    this.setColours(this.colours);
  }

  update(live) {
    this.live = live;
    const [x, y, z, qx, qy, qz, qw] = live.pose;
    this.group.visible = true;
    this.group.position.set(x, y, z);
    this.group.quaternion.set(qx, qy, qz, qw);
    const [xx, xy, yy] = live.covariance;
    const mean = (xx + yy) / 2;
    const part = Math.hypot((xx - yy) / 2, xy);
    const axes = [mean + part, Math.max(mean - part, 0)].map((variance) => ELLIPSE_SIGMAS * Math.sqrt(variance));
    this.ellipse.visible = axes[0] < LARGEST_ELLIPSE && axes[0] > 0;
    this.ellipse.position.set(x, y, z);
    this.ellipse.rotation.z = 0.5 * Math.atan2(2 * xy, xx - yy);
    this.ellipse.scale.set(Math.max(axes[0], 1e-4), Math.max(axes[1], 1e-4), 1);
    this.bend(live);
  }

  bend(live) {
    if (!this.array || !this.colours.free) return;
    const { base, rotation, length, present } = this.array;
    const rods = this.rods.geometry.attributes.position;
    const colours = this.rods.geometry.attributes.color;
    const tips = this.tips.geometry.attributes.position;
    let touching = 0;
    for (let k = 0; k < base.length; k++) {
      const tenths = live.inclination[k];
      const [inclination, azimuth] = [((tenths ?? 0) * Math.PI) / 1800, ((live.azimuth[k] ?? 0) * Math.PI) / 1800];
      const reach = present[k] ? length[k] : 0;
      const along = [Math.sin(inclination) * Math.cos(azimuth), Math.sin(inclination) * Math.sin(azimuth), Math.cos(inclination)];
      const R = rotation[k];
      const tip = [0, 1, 2].map((i) => base[k][i] + reach * (R[3 * i] * along[0] + R[3 * i + 1] * along[1] + R[3 * i + 2] * along[2]));
      rods.array.set(base[k], 6 * k);
      rods.array.set(tip, 6 * k + 3);
      const fault = this.faults[k] !== undefined || (tenths === null && live.inclination.length > 0);
      const colour = fault ? this.colours.fault : tenths > 0 ? this.colours.contact : this.colours.free;
      colour.toArray(colours.array, 6 * k);
      colour.toArray(colours.array, 6 * k + 3);
      if (tenths > 0 && !fault) tips.array.set(tip, 3 * touching++);
    }
    this.tips.material.color.copy(this.colours.contact);
    this.tips.geometry.setDrawRange(0, touching);
    rods.needsUpdate = colours.needsUpdate = tips.needsUpdate = true;
  }
}
