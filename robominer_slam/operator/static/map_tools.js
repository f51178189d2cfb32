// What the pointer does on the map: measure a distance or a height, set a waypoint, say where the robot is.
import { THREE } from "nicegui-scene";

const PICK_PIXELS = 9;
/** A press that moves farther turns the camera and picks nothing, pixels. */
const CLICK_PIXELS = 5;

const HINTS = {
  distance: "Click the first point, then the second",
  height: "Click a point of the map",
  waypoint: "Press where the robot shall go, drag to its heading, release",
  localize: "Press where the robot is, drag to its heading, release",
};

export class MapTools {
  constructor({ canvas, labels, hint, rig, cloud, onPlace, onDone, render }) {
    Object.assign(this, { canvas, labels, hint, rig, cloud, onPlace, onDone, render });
    this.group = new THREE.Group();
    this.marks = [];
    this.tool = null;
    this.robotZ = 0;
    this.colour = new THREE.Color("#ffffff");
    this.raycaster = new THREE.Raycaster();
    canvas.addEventListener("pointerdown", (event) => this.press(event), { capture: true });
    canvas.addEventListener("pointermove", (event) => this.drag(event));
    canvas.addEventListener("pointerup", (event) => this.release(event));
  }

  use(tool) {
    this.tool = this.tool === tool ? null : tool;
    this.first = null;
    this.pressed = null;
    this.rig.controls.enabled = true;
    this.hint.textContent = HINTS[this.tool] ?? "";
    this.canvas.style.cursor = this.tool ? "crosshair" : "";
    this.onDone(this.tool);
  }

  get aims() {
    return this.tool === "waypoint" || this.tool === "localize";
  }

  ray(event) {
    const { left, top, width, height } = this.canvas.getBoundingClientRect();
    const at = new THREE.Vector2(((event.clientX - left) / width) * 2 - 1, 1 - ((event.clientY - top) / height) * 2);
    this.raycaster.setFromCamera(at, this.rig.camera);
    return this.raycaster.ray;
  }

  /** The map's point under the pointer, or else the place at the height of the map's last ground. */
  pick(event) {
    const ray = this.ray(event);
    return this.cloud.pick(ray, ...this.rig.cone(PICK_PIXELS)) ?? this.onPlane(ray);
  }

  onPlane(ray) {
    const plane = new THREE.Plane(new THREE.Vector3(0, 0, 1), -this.robotZ);
    return ray.intersectPlane(plane, new THREE.Vector3());
  }

  press(event) {
    if (event.button !== 0) return;
    this.pressed = { x: event.clientX, y: event.clientY };
    if (!this.aims) return;
    // Aiming must not turn the camera.
    this.rig.controls.enabled = false;
    this.start = this.pick(event);
  }

  drag(event) {
    if (!this.pressed || !this.aims || !this.start) return;
    const end = this.onPlane(this.ray(event));
    if (end) this.draw([{ points: [this.start, end], text: "" }]);
  }

  release(event) {
    const pressed = this.pressed;
    this.pressed = null;
    if (!pressed || !this.tool) return;
    const moved = Math.hypot(event.clientX - pressed.x, event.clientY - pressed.y);
    if (this.aims) {
      const end = this.onPlane(this.ray(event));
      this.rig.controls.enabled = true;
      if (!this.start) return;
      const aimed = moved > CLICK_PIXELS && end;
      const yaw = aimed ? Math.atan2(end.y - this.start.y, end.x - this.start.x) : null;
      this.onPlace({ tool: this.tool, x: this.start.x, y: this.start.y, yaw });
      this.use(null);
      return;
    }
    if (moved > CLICK_PIXELS) return;
    const point = this.pick(event);
    if (!point) return;
    if (this.tool === "height") this.showHeight(point);
    if (this.tool === "distance") this.measure(point);
  }

  measure(point) {
    if (!this.first) {
      this.first = point;
      this.draw([{ points: [point], text: "" }]);
      return;
    }
    const [a, b] = [this.first, point];
    const level = Math.hypot(b.x - a.x, b.y - a.y);
    const text = `${a.distanceTo(b).toFixed(3)} m (level ${level.toFixed(3)} m, height ${(b.z - a.z).toFixed(3)} m)`;
    this.draw([{ points: [a, b], text }]);
    this.first = null;
  }

  showHeight(point) {
    const foot = new THREE.Vector3(point.x, point.y, 0);
    const below = this.robotZ - point.z;
    const text = `height ${point.z.toFixed(3)} m in the map, ${Math.abs(below).toFixed(3)} m ${below >= 0 ? "below" : "above"} the robot's base`;
    this.draw([{ points: [foot, point], text }]);
  }

  /** Each mark is a line through one or two points, with a label at its end. */
  draw(marks) {
    this.clear();
    this.marks = marks.map(({ points, text }) => {
      const geometry = new THREE.BufferGeometry().setFromPoints(points);
      const line = new THREE.Line(geometry, new THREE.LineBasicMaterial({ color: this.colour, depthTest: false }));
      const ends = new THREE.Points(geometry, new THREE.PointsMaterial({ color: this.colour, size: 8, sizeAttenuation: false, depthTest: false }));
      line.renderOrder = ends.renderOrder = 5;
      line.frustumCulled = ends.frustumCulled = false;
      this.group.add(line, ends);
      const label = document.createElement("div");
      label.className = "map-label";
      label.textContent = text;
      label.hidden = !text;
      this.labels.append(label);
      return { label, at: points[points.length - 1] };
    });
    this.render();
  }

  clear() {
    for (const object of [...this.group.children]) {
      this.group.remove(object);
      object.geometry.dispose();
      object.material.dispose();
    }
    for (const { label } of this.marks) label.remove();
    this.marks = [];
    this.render();
  }

  /** Labels stay at their points when the camera moves. */
  placeLabels() {
    for (const { label, at } of this.marks) {
      const seen = at.clone().project(this.rig.camera);
      label.style.transform = `translate(${((seen.x + 1) / 2) * this.rig.width}px, ${((1 - seen.y) / 2) * this.rig.height}px)`;
      label.style.visibility = seen.z < 1 ? "visible" : "hidden";
    }
  }
}
