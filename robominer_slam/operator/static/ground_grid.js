// Lines a metre apart below the map, around what the camera looks at.
import { THREE } from "nicegui-scene";

const HALF = 20;

export class GroundGrid {
  constructor() {
    const points = [];
    // Of short pieces: long lines that pass behind the camera are lost by some graphics.
    for (let i = -HALF; i <= HALF; i++) {
      for (let k = -HALF; k < HALF; k++) points.push(i, k, 0, i, k + 1, 0, k, i, 0, k + 1, i, 0);
    }
    const geometry = new THREE.BufferGeometry();
    geometry.setAttribute("position", new THREE.BufferAttribute(new Float32Array(points), 3));
    this.object = new THREE.LineSegments(geometry, new THREE.LineBasicMaterial());
    this.object.frustumCulled = false;
  }

  setColours(colours) {
    this.object.material.color.set(colours.grid);
  }

  moveTo(target, height) {
    this.object.position.set(Math.round(target.x), Math.round(target.y), height);
  }
}
