// Two cameras over one target: in perspective, and straight from above with north up; both may follow the robot.
import { OrbitControls, THREE } from "nicegui-scene";

const FIELD_OF_VIEW = 50;
/** What a camera shows at first, m across. */
const FIRST_WIDTH = 3;

export class CameraRig {
  constructor(element, onChange) {
    this.perspective = new THREE.PerspectiveCamera(FIELD_OF_VIEW, 1, 0.05, 5000);
    this.perspective.up.set(0, 0, 1);
    this.perspective.position.set(-1.3, -1.3, 1.4);
    this.above = new THREE.OrthographicCamera(-1, 1, 1, -1, -1000, 5000);
    this.above.position.set(0, 0, 1000);
    this.orbit = new OrbitControls(this.perspective, element);
    this.pan = new OrbitControls(this.above, element);
    this.pan.enableRotate = false;
    this.pan.screenSpacePanning = true;
    this.pan.mouseButtons = { LEFT: THREE.MOUSE.PAN, MIDDLE: THREE.MOUSE.DOLLY, RIGHT: THREE.MOUSE.PAN };
    this.pan.touches = { ONE: THREE.TOUCH.PAN, TWO: THREE.TOUCH.DOLLY_PAN };
    this.orbit.maxPolarAngle = 0.95 * Math.PI;
    for (const controls of [this.orbit, this.pan]) {
      controls.minDistance = 0.2;
      controls.maxDistance = 3000;
      controls.addEventListener("change", onChange);
    }
    this.onChange = onChange;
    this.follow = true;
    this.robot = null;
    this.use("3d");
  }

  get camera() {
    return this.mode === "top" ? this.above : this.perspective;
  }

  get controls() {
    return this.mode === "top" ? this.pan : this.orbit;
  }

  use(mode) {
    const target = this.controls.target.clone();
    this.mode = mode;
    this.orbit.enabled = mode !== "top";
    this.pan.enabled = mode === "top";
    this.moveTo(target);
  }

  resize(width, height) {
    this.width = width;
    this.height = height;
    this.perspective.aspect = width / height;
    this.perspective.updateProjectionMatrix();
    const half = FIRST_WIDTH / 2;
    Object.assign(this.above, { left: -half, right: half, top: (half * height) / width, bottom: (-half * height) / width });
    this.above.updateProjectionMatrix();
    this.onChange();
  }

  /** Move target and camera together, so that the view keeps its direction and distance. */
  moveTo(target) {
    const step = target.clone().sub(this.controls.target);
    this.controls.target.add(step);
    this.camera.position.add(step);
    if (this.mode === "top") this.above.position.set(target.x, target.y, target.z + 1000);
    this.controls.update();
    this.onChange();
  }

  /** The robot has moved: go with it if it is followed. */
  robotAt(x, y, z) {
    const place = new THREE.Vector3(x, y, z);
    if (this.follow && (!this.robot || this.robot.distanceToSquared(place) > 1e-8)) this.moveTo(place);
    this.robot = place;
  }

  setFollow(follow) {
    this.follow = follow;
    if (follow && this.robot) this.moveTo(this.robot);
  }

  /** Show all of a box. */
  fit(box) {
    if (box.isEmpty()) return;
    this.follow = false;
    const size = box.getSize(new THREE.Vector3());
    const centre = box.getCenter(new THREE.Vector3());
    this.moveTo(centre);
    if (this.mode === "top") {
      const wide = (this.above.right - this.above.left) / (1.1 * Math.max(size.x, 0.5));
      const high = (this.above.top - this.above.bottom) / (1.1 * Math.max(size.y, 0.5));
      this.above.zoom = Math.min(wide, high);
      this.above.updateProjectionMatrix();
    } else {
      const radius = 0.5 * size.length();
      const away = this.perspective.position.clone().sub(centre).normalize();
      const angle = (FIELD_OF_VIEW * Math.PI) / 360;
      const distance = radius / Math.sin(Math.min(angle, Math.atan(Math.tan(angle) * this.perspective.aspect)));
      this.perspective.position.copy(centre).addScaledVector(away, 1.05 * distance);
    }
    this.controls.update();
    this.onChange();
  }

  zoom(factor) {
    if (this.mode === "top") {
      this.above.zoom *= factor;
      this.above.updateProjectionMatrix();
    } else {
      const { position } = this.perspective;
      position.sub(this.orbit.target).divideScalar(factor).add(this.orbit.target);
    }
    this.controls.update();
    this.onChange();
  }

  /** Move over the ground by parts of the view's width. */
  step(right, up) {
    this.follow = false;
    const reach = 0.1 * this.width * this.metresPerPixel();
    const ahead = this.heading();
    const target = this.controls.target.clone();
    target.x += reach * (right * Math.sin(ahead) + up * Math.cos(ahead));
    target.y += reach * (-right * Math.cos(ahead) + up * Math.sin(ahead));
    this.moveTo(target);
  }

  /** Direction in map that points up on the screen, rad from x. */
  heading() {
    if (this.mode === "top") return Math.PI / 2;
    const view = this.orbit.target.clone().sub(this.perspective.position);
    return Math.atan2(view.y, view.x);
  }

  /** At the target. */
  metresPerPixel() {
    if (this.mode === "top") return (this.above.right - this.above.left) / this.above.zoom / this.width;
    const distance = this.perspective.position.distanceTo(this.orbit.target);
    return (2 * distance * Math.tan((FIELD_OF_VIEW * Math.PI) / 360)) / this.height;
  }

  /** Pixels that 1 m takes at a distance of 1 m (in perspective) or anywhere (from above). */
  pixelsPerMetre() {
    if (this.mode === "top") return 1 / this.metresPerPixel();
    return this.height / (2 * Math.tan((FIELD_OF_VIEW * Math.PI) / 360));
  }

  /** Cone around a ray that takes in so many pixels: slope (m per m) and radius (m). */
  cone(pixels) {
    return this.mode === "top" ? [0, pixels * this.metresPerPixel()] : [pixels / this.pixelsPerMetre(), 0];
  }
}
