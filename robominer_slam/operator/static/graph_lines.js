// Keyframes, the path through them, loop closures, and the way driven.
import { THREE } from "nicegui-scene";

/** Loop closures are arcs, so that they are told from the path: so many lines each, and so high for their length. */
const ARC_LINES = 8;
const ARC_HEIGHT = 0.25;

export class GraphLines {
  constructor() {
    this.group = new THREE.Group();
    this.places = new THREE.BufferGeometry();
    this.path = new THREE.Line(this.places, new THREE.LineBasicMaterial({ transparent: true, opacity: 0.55 }));
    this.keyframes = new THREE.Points(this.places, new THREE.PointsMaterial({ size: 4, sizeAttenuation: false }));
    this.closures = new THREE.LineSegments(new THREE.BufferGeometry(), new THREE.LineBasicMaterial({ transparent: true, opacity: 0.8 }));
    this.trail = new THREE.Line(new THREE.BufferGeometry(), new THREE.LineBasicMaterial());
    this.pairs = [];
    this.times = [];
    for (const object of [this.path, this.keyframes, this.closures, this.trail]) {
      object.frustumCulled = false;
      this.group.add(object);
    }
    this.keyframes.renderOrder = 2;
  }

  setColours(colours) {
    this.path.material.color.set(colours.keyframe);
    this.keyframes.material.color.set(colours.keyframe);
    this.closures.material.color.set(colours.closure);
    this.trail.material.color.set(colours.path);
  }

  /** Keyframes lie at the robot's height, on which the whiskers hang. */
  update(poses, slots, first = 0) {
    let values = this.places.getAttribute("position");
    if (!values || values.count < slots) {
      values = new THREE.BufferAttribute(new Float32Array(3 * Math.max(256, 2 * slots)), 3);
      this.places.setAttribute("position", values);
      first = 0;
    }
    const to = values.array;
    for (let k = first; k < slots; k++) {
      // A keyframe that has gone leaves no gap in the path.
      const there = poses[8 * k + 3] > 0.5 || k === 0;
      for (let i = 0; i < 3; i++) to[3 * k + i] = there ? poses[8 * k + i] : to[3 * (k - 1) + i];
    }
    values.addUpdateRange(3 * first, 3 * (slots - first));
    values.needsUpdate = true;
    this.count = slots;
    // New keyframes at the end move no closure.
    if (first < (this.lastPaired ?? 0)) this.updateClosures(poses);
    this.show(this.shown ?? slots);
  }

  /** Another map begins. */
  clear() {
    this.count = 0;
    this.setPairs([], new Float32Array(0));
    this.setTrail([]);
  }

  setPairs(pairs, poses) {
    this.pairs = pairs;
    this.lastPaired = pairs.reduce((most, slot) => Math.max(most, slot + 1), 0);
    this.updateClosures(poses);
  }

  updateClosures(poses) {
    const positions = [];
    for (let k = 0; k < this.pairs.length; k += 2) {
      const [i, j] = [8 * this.pairs[k], 8 * this.pairs[k + 1]];
      const rise = ARC_HEIGHT * Math.hypot(poses[j] - poses[i], poses[j + 1] - poses[i + 1]) + 0.02;
      const at = (share) => [0, 1, 2].map((m) => poses[i + m] + share * (poses[j + m] - poses[i + m]) + (m === 2 ? 4 * rise * share * (1 - share) : 0));
      for (let n = 0; n < ARC_LINES; n++) positions.push(...at(n / ARC_LINES), ...at((n + 1) / ARC_LINES));
    }
    this.closures.geometry.dispose();
    this.closures.geometry = new THREE.BufferGeometry();
    this.closures.geometry.setAttribute("position", new THREE.BufferAttribute(new Float32Array(positions), 3));
    this.show(this.shown ?? Infinity);
  }

  /** Only the first keyframes, as many as there were at the moment that is looked at. */
  show(slots) {
    this.shown = slots;
    this.places.setDrawRange(0, Math.min(slots, this.count ?? 0));
    let pairs = 0;
    while (pairs < this.pairs.length && Math.max(this.pairs[pairs], this.pairs[pairs + 1]) < slots) pairs += 2;
    this.closures.geometry.setDrawRange(0, pairs * ARC_LINES);
  }

  /** `points`: seconds, x, y, z of places driven through, flat. */
  setTrail(points) {
    const count = points.length / 4;
    const positions = new Float32Array(3 * count);
    this.times = [];
    for (let k = 0; k < count; k++) {
      this.times.push(points[4 * k]);
      positions.set(points.slice(4 * k + 1, 4 * k + 4), 3 * k);
    }
    this.trail.geometry.dispose();
    this.trail.geometry = new THREE.BufferGeometry();
    this.trail.geometry.setAttribute("position", new THREE.BufferAttribute(positions, 3));
    this.showTrail(this.until ?? Infinity);
  }

  /** The way up to so many seconds after the first place. */
  showTrail(seconds) {
    this.until = seconds;
    let count = this.times.length;
    while (count > 0 && this.times[count - 1] > seconds) count--;
    this.trail.geometry.setDrawRange(0, count);
  }
}
