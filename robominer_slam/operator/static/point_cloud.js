// The map's points. Each stays in its keyframe's frame; the vertex shader moves it with the keyframe's pose, which
// lies in a texture: a corrected graph costs some small textures, however many points there are. Every chunk has a
// texture of its own, because part of a texture cannot be replaced without waiting for the graphics.
import { THREE } from "nicegui-scene";
import { colourBytes } from "./colours.js";

/** Keyframes to a chunk, as in `map_model.py`. */
const CHUNK = 128;
/** Of whiskers, from the robot's middle, m. */
const REACH = 0.4;

const VERTEX = `
precision highp float;
precision highp int;
precision highp sampler2D;
uniform mat4 modelViewMatrix, projectionMatrix;
uniform sampler2D poses;
uniform int firstSlot, slotsShown;
uniform float size, pixels, unit;
in vec4 position;
out float height;
void main() {
  int slot = int(position.w);
  vec4 place = texelFetch(poses, ivec2(2 * slot, 0), 0);
  vec4 q = texelFetch(poses, ivec2(2 * slot + 1, 0), 0);
  vec3 v = unit * position.xyz;
  vec3 point = v + 2.0 * cross(q.xyz, cross(q.xyz, v) + q.w * v) + place.xyz;
  height = point.z;
  vec4 seen = projectionMatrix * (modelViewMatrix * vec4(point, 1.0));
  bool shown = firstSlot + slot < slotsShown && place.w > 0.5;
  gl_Position = shown ? seen : vec4(2.0, 2.0, 2.0, 1.0);
  // As large as they are in the world, but never too small to be seen.
  gl_PointSize = clamp(size * pixels / seen.w, 2.0, 32.0);
}`;

const FRAGMENT = `
precision highp float;
uniform sampler2D colours;
uniform vec2 heights;
uniform float faded;
in float height;
out vec4 colour;
void main() {
  float share = clamp((height - heights.x) / (heights.y - heights.x), 0.0, 1.0);
  colour = vec4(mix(texture(colours, vec2(share, 0.5)).rgb, vec3(0.5), faded), 1.0);
}`;

export class PointCloud {
  constructor() {
    this.group = new THREE.Group();
    this.chunks = [];
    this.textures = [];
    this.poses = new Float32Array(0);
    this.material = new THREE.RawShaderMaterial({
      glslVersion: THREE.GLSL3,
      vertexShader: VERTEX,
      fragmentShader: FRAGMENT,
      uniforms: {
        poses: { value: null },
        colours: { value: null },
        firstSlot: { value: 0 },
        slotsShown: { value: 1 << 30 },
        heights: { value: new THREE.Vector2(0, 1) },
        size: { value: 0.022 },
        unit: { value: 0.005 },
        pixels: { value: 1000 },
        faded: { value: 0 },
      },
    });
    this.setColours("viridis");
  }

  setColours(name) {
    const texture = new THREE.DataTexture(colourBytes(name), 256, 1, THREE.RGBAFormat);
    texture.minFilter = texture.magFilter = THREE.LinearFilter;
    texture.needsUpdate = true;
    this.material.uniforms.colours.value?.dispose();
    this.material.uniforms.colours.value = texture;
  }

  /** Room for so many keyframes' poses: all of them in a row, and by chunk for the graphics. */
  reserve(slots) {
    while (this.textures.length * CHUNK < slots) {
      const texture = new THREE.DataTexture(new Float32Array(8 * CHUNK), 2 * CHUNK, 1, THREE.RGBAFormat, THREE.FloatType);
      texture.needsUpdate = true;
      this.textures.push(texture);
    }
    if (this.poses.length >= 8 * slots) return;
    const grown = new Float32Array(16 * slots);
    grown.set(this.poses);
    this.poses = grown;
  }

  clear() {
    for (const chunk of this.chunks) this.remove(chunk);
    for (const texture of this.textures) texture.dispose();
    this.chunks = [];
    this.textures = [];
    this.poses.fill(0);
  }

  takePoses(first, values) {
    const count = values.length / 8;
    this.reserve(first + count);
    this.poses.set(values, 8 * first);
    for (let k = Math.floor(first / CHUNK); k * CHUNK < first + count; k++) {
      const texture = this.textures[k];
      texture.image.data.set(this.poses.subarray(8 * CHUNK * k, 8 * CHUNK * (k + 1)));
      texture.needsUpdate = true;
    }
  }

  takePoints(index, points) {
    this.remove(this.chunks[index]);
    this.reserve((index + 1) * CHUNK);
    const geometry = new THREE.BufferGeometry();
    geometry.setAttribute("position", new THREE.BufferAttribute(points, 4));
    geometry.boundingSphere = this.spheres?.[index] ?? new THREE.Sphere(new THREE.Vector3(), Infinity);
    const object = new THREE.Points(geometry, this.material);
    object.onBeforeRender = () => {
      this.material.uniforms.firstSlot.value = index * CHUNK;
      this.material.uniforms.poses.value = this.textures[index];
      this.material.uniformsNeedUpdate = true;
    };
    // Nothing moves as an object: its matrix need not be looked at.
    object.matrixAutoUpdate = false;
    this.chunks[index] = object;
    this.group.add(object);
  }

  remove(object) {
    if (!object) return;
    this.group.remove(object);
    object.geometry.dispose();
  }

  takeBounds(bounds, heights) {
    this.spheres ??= [];
    bounds.forEach(([x, y, z, radius], k) => {
      this.spheres[k] ??= new THREE.Sphere();
      this.spheres[k].center.set(x, y, z);
      this.spheres[k].radius = radius;
      if (this.chunks[k]) this.chunks[k].geometry.boundingSphere = this.spheres[k];
    });
    this.spheres.length = bounds.length;
    this.material.uniforms.heights.value.set(...heights);
  }

  /** Draw this share of the points; any first part of a chunk is a fair sample of it. */
  setDetail(share) {
    for (const object of this.chunks) {
      object?.geometry.setDrawRange(0, Math.ceil(share * object.geometry.attributes.position.count));
    }
  }

  /** Box around all keyframes and what the whiskers reach from them. */
  box() {
    const box = new THREE.Box3();
    const place = new THREE.Vector3();
    for (let k = 0; k < this.poses.length; k += 8) {
      if (this.poses[k + 3] > 0.5) box.expandByPoint(place.fromArray(this.poses, k));
    }
    return box.isEmpty() ? box : box.expandByVector(new THREE.Vector3(REACH, REACH, 0));
  }

  /** The point nearest to a ray, within a cone of `slope` m per m and `radius` m; null if there is none. */
  pick(ray, slope, radius) {
    let best = null;
    const v = new THREE.Vector3();
    const q = new THREE.Quaternion();
    const place = new THREE.Vector3();
    const shown = this.material.uniforms.slotsShown.value;
    const unit = this.material.uniforms.unit.value;
    this.chunks.forEach((object, index) => {
      if (!object || !ray.intersectsSphere(object.geometry.boundingSphere)) return;
      const points = object.geometry.attributes.position.array;
      for (let k = 0; k < points.length; k += 4) {
        const slot = index * CHUNK + points[k + 3];
        const p = 8 * slot;
        if (slot >= shown || this.poses[p + 3] < 0.5) continue;
        q.fromArray(this.poses, p + 4);
        v.set(points[k], points[k + 1], points[k + 2]).multiplyScalar(unit).applyQuaternion(q).add(place.fromArray(this.poses, p));
        const along = v.clone().sub(ray.origin).dot(ray.direction);
        const miss = Math.sqrt(ray.distanceSqToPoint(v));
        const reach = radius + slope * along;
        // Of the points under the pointer the nearest one to the eye: that is the surface.
        if (along > 0 && miss < reach && (!best || along + 4 * miss < best.rank)) best = { point: v.clone(), rank: along + 4 * miss };
      }
    });
    return best?.point ?? null;
  }
}
