// The map: a scene that is drawn when something in it has changed, and the tools over it.
import { THREE } from "nicegui-scene";
import { CameraRig, COLOUR_MAPS, drawScaleBar, GraphLines, gradient, GroundGrid, MapTools, PointCloud, RobotModel, stream } from "robominer-console";
import { sceneColours } from "robominer-console/colours.js";

/** Between being asked for a drawing and drawing: above the first the graphics are overloaded, below the second not. */
const LATE_MS = 60;
const EARLY_MS = 25;
/** The picture rests when nothing was drawn for so long. */
const REST_MS = 300;
/** So many points are always drawn. */
const LEAST_POINTS = 60000;
const LAYERS = { points: "Points", path: "Path", keyframes: "Keyframes", closures: "Loop closures", trail: "Way driven", robot: "Robot" };

/** Without a graphics card smooth edges cost more than they are worth. */
function drawnInSoftware() {
  const gl = document.createElement("canvas").getContext("webgl2");
  const info = gl?.getExtension("WEBGL_debug_renderer_info");
  const name = info ? gl.getParameter(info.UNMASKED_RENDERER_WEBGL) : "";
  gl?.getExtension("WEBGL_lose_context")?.loseContext();
  return /swiftshader|llvmpipe|software/i.test(name);
}

/** In place of a renderer where the browser has none: the page's panels and commands go on. */
const UNDRAWN = { setPixelRatio() {}, getPixelRatio: () => 1, setSize() {}, render() {} };

export default {
  template: `
    <div class="map-view" data-testid="map">
      <canvas tabindex="0" aria-label="Map; keys: ? for help"></canvas>
      <div ref="labels" class="map-labels"></div>
      <div class="map-tools" role="toolbar" aria-label="Map">
        <div class="tool-group">
          <button :aria-pressed="mode==='3d'" @click="setMode('3d')" title="In 3D (P)">3D</button>
          <button :aria-pressed="mode==='top'" @click="setMode('top')" title="From above (T)">Top</button>
        </div>
        <div class="tool-group">
          <button :aria-pressed="follow" @click="setFollow(true)" title="Follow the robot (F)">Follow</button>
          <button :aria-pressed="!follow" @click="setFollow(false)" title="Free camera (F)">Free</button>
          <button @click="fit()" title="Show the whole map (A)">All</button>
        </div>
        <div class="tool-group">
          <button :aria-pressed="tool==='distance'" @click="useTool('distance')" title="Measure a distance (M)">Distance</button>
          <button :aria-pressed="tool==='height'" @click="useTool('height')" title="Measure a height (H)">Height</button>
        </div>
        <div class="tool-group" v-show="waypoints">
          <button data-testid="waypoint" :aria-pressed="tool==='waypoint'" @click="useTool('waypoint')" title="Send the simulated robot there (W)">Waypoint</button>
        </div>
        <div class="tool-group">
          <button :aria-expanded="layersOpen" @click="layersOpen=!layersOpen" title="What is shown">Layers</button>
          <div class="layer-menu" v-show="layersOpen">
            <label v-for="(text, name) in layers"><input type="checkbox" :checked="shown[name]" @change="toggle(name)"> {{ text }}</label>
            <label>Heights <select :value="palette" @change="setPalette($event.target.value)"><option v-for="name in palettes">{{ name }}</option></select></label>
          </div>
        </div>
      </div>
      <div ref="hint" class="map-hint" aria-live="polite"></div>
      <div class="map-legend" aria-label="Heights in metres">
        <span class="legend-title">height (m)</span>
        <div class="legend-row">
          <div class="legend-bar" :style="{background: legend}"></div>
          <div class="legend-ticks"><span v-for="tick in ticks">{{ tick }}</span></div>
        </div>
      </div>
      <div class="map-compass" title="Axes of the map frame; its north is +y"><svg viewBox="-24 -24 48 48" ref="compass"><circle r="22"/><path d="M0,-17 L7,12 L0,7 L-7,12 Z"/></svg><span>N (map +y)</span></div>
      <div class="map-corner"><div ref="scale" class="map-scale"></div><span ref="count" class="map-count"></span></div>
      <div class="map-empty" role="alert" data-testid="no-graphics" v-if="graphicsFault">The map cannot be drawn: this browser offers no WebGL 2 ({{ graphicsFault }}). Switch on hardware acceleration in its settings, or use another browser. Panels and commands work.</div>
      <div class="map-empty" v-else v-show="empty">No map yet: it grows where whiskers touch</div>
    </div>`,
  props: { dark: Boolean },
  data() {
    return {
      mode: "3d", follow: true, tool: null, waypoints: false, layersOpen: false, layers: LAYERS, palettes: Object.keys(COLOUR_MAPS),
      palette: "viridis", heights: [0, 1], empty: true, graphicsFault: "", shown: Object.fromEntries(Object.keys(LAYERS).map((name) => [name, true])),
    };
  },
  computed: {
    legend() {
      return gradient(this.palette);
    },
    ticks() {
      const [low, high] = this.heights;
      const digits = high - low < 0.5 ? 3 : 2;
      return [1, 0.75, 0.5, 0.25, 0].map((share) => (low + share * (high - low)).toFixed(digits));
    },
  },
  mounted() {
    const canvas = this.$el.querySelector("canvas");
    // Kept out of Vue's sight: it must not watch a million points.
    const own = (this.own = Object.create(null));
    const plain = drawnInSoftware();
    try {
      own.renderer = new THREE.WebGLRenderer({ canvas, antialias: !plain, powerPreference: "high-performance" });
    } catch (error) {
      this.graphicsFault = error.message;
      own.renderer = UNDRAWN;
    }
    own.renderer.setPixelRatio(plain ? 1 : Math.min(window.devicePixelRatio, 2));
    own.scene = new THREE.Scene();
    own.cloud = new PointCloud();
    own.lines = new GraphLines();
    own.robot = new RobotModel();
    own.grid = new GroundGrid();
    own.rig = new CameraRig(canvas, () => this.render());
    own.tools = new MapTools({
      canvas, labels: this.$refs.labels, hint: this.$refs.hint, rig: own.rig, cloud: own.cloud, render: () => this.render(),
      onPlace: (place) => this.$emit("place", place), onDone: (tool) => (this.tool = tool),
    });
    own.scene.add(own.grid.object, own.cloud.group, own.lines.group, own.robot.group, own.robot.ellipse, own.tools.group);
    own.detail = 1;
    this.setDark(this.dark);
    new ResizeObserver(() => this.resize()).observe(this.$el);
    this.listen();
    stream.start();
  },
  watch: {
    dark(value) {
      this.setDark(value);
    },
  },
  methods: {
    listen() {
      const { cloud, lines, robot, rig, tools } = this.own;
      const scene = (take) => (message) => {
        take(message);
        this.render();
      };
      stream.on("array", scene((message) => robot.setArray(message)));
      stream.on("live", scene((live) => {
        robot.update(live);
        tools.robotZ = live.pose[2];
        rig.robotAt(...live.pose.slice(0, 3));
        const slots = live.past ? live.slots : 1 << 30;
        cloud.material.uniforms.slotsShown.value = slots;
        lines.show(slots);
        lines.showTrail(live.past ? (live.stamp - live.span[0]) / 1000 : Infinity);
        this.own.stamp = live.past ? null : live.stamp;
      }));
      stream.on("map", scene((message) => {
        if (message.reset) {
          cloud.clear();
          lines.clear();
        }
        cloud.material.uniforms.unit.value = message.unit;
        cloud.material.uniforms.size.value = 1.15 * message.spacing;
        cloud.takeBounds(message.bounds, message.heights);
        this.own.slots = message.slots;
        this.own.low = message.heights[0] - 0.02;
        // Vue draws the legend anew for every new array.
        if (message.heights.some((value, k) => value !== this.heights[k])) this.heights = message.heights;
        this.own.points = message.points;
        this.empty = message.points === 0;
        this.tellCount();
      }));
      stream.on("poses", scene(({ first, values }) => {
        cloud.takePoses(first, values);
        lines.update(cloud.poses, Math.max(this.own.slots, first + values.length / 8), first);
      }));
      stream.on("points", scene(({ chunk, points }) => {
        cloud.takePoints(chunk, points);
        cloud.setDetail(this.own.share ?? 1);
      }));
      stream.on("closures", scene(({ pairs }) => lines.setPairs(pairs, cloud.poses)));
      stream.on("trail", scene(({ points }) => lines.setTrail(points)));
      stream.on("readings", (message) => {
        this.waypoints = message.waypoints;
        robot.faults = message.whiskers;
      });
      stream.on("link", scene(({ state }) => (cloud.material.uniforms.faded.value = state === "stale" ? 0.55 : 0)));
    },
    /** Draw once, soon: however many changes come before. */
    render() {
      const own = this.own;
      if (own.asked) return;
      own.asked = performance.now();
      requestAnimationFrame(() => this.draw());
    },
    draw() {
      const own = this.own;
      const begin = performance.now();
      this.adapt(begin - own.asked);
      own.asked = null;
      if (!own.rig.width) return;
      own.cloud.material.uniforms.pixels.value = own.rig.pixelsPerMetre() * own.renderer.getPixelRatio();
      own.grid.moveTo(own.rig.controls.target, this.own.low ?? 0);
      own.renderer.render(own.scene, own.rig.camera);
      own.tools.placeLabels();
      drawScaleBar(this.$refs.scale, own.rig.metresPerPixel());
      const north = 90 - (own.rig.heading() * 180) / Math.PI;
      this.$refs.compass.style.transform = `rotate(${-north}deg)`;
      if (this.follow !== own.rig.follow) this.follow = own.rig.follow;
      const { stats } = stream;
      stats.frames += 1;
      stats.script = performance.now() - begin;
      if (own.stamp) stats.latency = Date.now() - own.stamp;
      own.stamp = null;
    },
    /** Fewer points where the graphics cannot follow; all of them once the picture rests. */
    adapt(waited) {
      const own = this.own;
      if (!own.resting) {
        if (waited > LATE_MS) own.detail = Math.max(Math.min(1, LEAST_POINTS / (own.points || 1)), 0.7 * own.detail);
        else if (waited < EARLY_MS) own.detail = Math.min(1, 1.08 * own.detail);
      }
      const share = own.resting ? 1 : own.detail;
      own.resting = false;
      clearTimeout(own.rest);
      if (share < 1) {
        own.rest = setTimeout(() => {
          own.resting = true;
          this.render();
        }, REST_MS);
      }
      if (share === own.share) return;
      own.share = stream.stats.detail = share;
      own.cloud.setDetail(share);
      this.tellCount();
    },
    tellCount() {
      const { points = 0, share = 1 } = this.own;
      const drawn = share < 1 ? `, ${Math.round(100 * share)} % drawn` : "";
      const text = `${points.toLocaleString("en")} points${drawn}`;
      if (this.$refs.count.textContent !== text) this.$refs.count.textContent = text;
    },
    resize() {
      const { clientWidth: width, clientHeight: height } = this.$el;
      if (!width || !height) return;
      this.own.renderer.setSize(width, height, false);
      this.own.rig.resize(width, height);
    },
    setDark(dark) {
      const own = this.own;
      const colours = sceneColours(dark);
      own.scene.background = new THREE.Color(colours.background);
      own.grid.setColours(colours);
      own.robot.setColours(colours);
      own.lines.setColours(colours);
      own.tools.colour.set(colours.tool);
      this.render();
    },
    setMode(mode) {
      this.mode = mode;
      this.own.rig.use(mode);
    },
    setFollow(follow) {
      this.own.rig.setFollow(follow);
      this.follow = follow;
      this.render();
    },
    fit() {
      this.own.rig.fit(this.own.cloud.box());
    },
    useTool(tool) {
      if (tool === "waypoint" && !this.waypoints) return;
      this.own.tools.use(tool);
    },
    clearTools() {
      this.own.tools.use(null);
      this.own.tools.clear();
      this.layersOpen = false;
    },
    move(right, up) {
      this.own.rig.step(right, up);
    },
    zoom(factor) {
      this.own.rig.zoom(factor);
    },
    toggle(name) {
      const { cloud, lines, robot } = this.own;
      const shown = (this.shown[name] = !this.shown[name]);
      const parts = { points: [cloud.group], path: [lines.path], keyframes: [lines.keyframes], closures: [lines.closures], trail: [lines.trail], robot: [robot.body, robot.ellipse] };
      for (const part of parts[name]) part.visible = shown;
      this.render();
    },
    setPalette(name) {
      this.palette = name;
      this.own.cloud.setColours(name);
      this.render();
    },
  },
};
