// The array as it is mounted, seen from above with the front up: each whisker's bend, and how it is.
import { COLOUR_MAPS, stream } from "robominer-console";

const SCALE = 1000;
/** Inclination at which a whisker's mark is as long as it gets, deg. */
const FULL_BEND = 45;
const SHORT = { drifting: "Dr", bent: "Be", broken: "Br", flipped: "Fl", noisy: "No", saturated: "Sa", stuck: "St", dead: "De", silent: "Si" };

export default {
  template: `
    <div class="whisker-panel follows-link" data-testid="whiskers">
      <svg :viewBox="box" role="group" aria-label="Whiskers from above, front up">
        <text class="front" :x="frontX" :y="frontY" :style="{fontSize: frontSize + 'px'}">front</text>
        <g v-for="w in whiskers" :key="w.index" class="whisker" :class="{chosen: w.index===chosen}" :transform="w.place" tabindex="0" role="button"
           :data-whisker="w.index" :aria-label="w.label" @click="choose(w.index)" @keydown.enter="choose(w.index)">
          <circle :r="radius" class="socket"/>
          <line x1="0" y1="0" x2="0" y2="0" class="bend"/>
          <text class="fault" dy="0.36em" :style="{fontSize: radius + 'px'}"></text>
          <title>{{ w.label }}</title>
        </g>
      </svg>
      <div class="whisker-key"><span class="key-free">free</span><span class="key-touch">bent (length: inclination)</span><span class="key-fault">left out</span></div>
      <div class="whisker-detail" aria-live="polite" data-testid="whisker-detail">{{ detail }}</div>
    </div>`,
  data() {
    return { whiskers: [], box: "0 0 1 1", radius: 14, chosen: null, detail: "Click a whisker for its history", frontX: 0, frontY: 0, frontSize: 22 };
  },
  mounted() {
    this.marks = [];
    this.faults = {};
    stream.on("array", (array) => this.setArray(array));
    stream.on("readings", (message) => {
      this.faults = message.whiskers;
      if (this.live) this.show(this.live);
    });
    stream.on("live", (live) => {
      this.live = live;
      this.show(live);
    });
  },
  methods: {
    async setArray(array) {
      this.array = array;
      const seen = array.base.map((p, k) => [-SCALE * p[1], -SCALE * p[0], k]).filter(([, , k]) => array.present[k]);
      const [xs, ys] = [seen.map((p) => p[0]), seen.map((p) => p[1])];
      let gap = Infinity;
      for (const [x, y, k] of seen) for (const [u, v, m] of seen) if (m < k) gap = Math.min(gap, Math.hypot(x - u, y - v));
      this.radius = 0.42 * Math.min(gap, 80);
      const rim = 2.2 * this.radius;
      const width = Math.max(...xs) - Math.min(...xs) + 2 * rim;
      this.frontSize = width / 24;
      const [left, top] = [Math.min(...xs) - rim, Math.min(...ys) - rim - this.frontSize];
      this.box = `${left} ${top} ${width} ${Math.max(...ys) + rim - top}`;
      [this.frontX, this.frontY] = [(Math.min(...xs) + Math.max(...xs)) / 2, top + this.frontSize];
      this.whiskers = seen.map(([x, y, k]) => ({
        index: k, place: `translate(${x.toFixed(1)} ${y.toFixed(1)})`, label: `whisker, row ${Math.floor(k / array.cols)}, column ${k % array.cols}`,
      }));
      await this.$nextTick();
      this.marks = [];
      for (const group of this.$el.querySelectorAll(".whisker")) {
        const [line, text] = [group.querySelector(".bend"), group.querySelector(".fault")];
        this.marks[Number(group.dataset.whisker)] = { group, line, text, shown: "" };
      }
      if (this.live) this.show(this.live);
    },
    /** Only what has changed is written to the page. */
    show(live) {
      this.marks.forEach((mark, k) => {
        const tenths = live.inclination[k];
        const fault = this.faults[k] ?? (tenths === null ? "no usable reading" : undefined);
        const state = fault ? "fault" : tenths > 0 ? "touch" : "free";
        const shown = `${state} ${fault ?? ""} ${tenths} ${live.azimuth[k]}`;
        if (shown === mark.shown) return;
        mark.shown = shown;
        if (mark.group.dataset.state !== state) mark.group.dataset.state = state;
        mark.group.dataset.inclination = tenths ?? "";
        mark.text.textContent = fault ? (SHORT[fault.split(" ")[0]] ?? "×") : "";
        if (state === "touch") this.bend(mark, k, tenths / 10, live.azimuth[k] / 10);
      });
      this.tell();
    },
    bend(mark, k, inclination, azimuth) {
      const angle = (azimuth * Math.PI) / 180;
      const R = this.array.rotation[k];
      // Where the tip goes, in base_link: forward is up on the panel, left is left.
      const [forward, left] = [0, 1].map((i) => R[3 * i] * Math.cos(angle) + R[3 * i + 1] * Math.sin(angle));
      const reach = 1.7 * this.radius * Math.min(1, inclination / FULL_BEND);
      const level = Math.hypot(forward, left) || 1;
      mark.line.setAttribute("x2", ((-left / level) * reach).toFixed(1));
      mark.line.setAttribute("y2", ((-forward / level) * reach).toFixed(1));
    },
    choose(index) {
      this.chosen = index;
      this.tell();
      this.$emit("choose", { index });
    },
    tell() {
      if (this.chosen === null || !this.live) return;
      const k = this.chosen;
      const tenths = this.live.inclination[k];
      const place = `Row ${Math.floor(k / this.array.cols)}, column ${k % this.array.cols}: `;
      const bend = tenths === null || tenths === undefined ? "no usable reading" : tenths > 0 ? `inclination ${(tenths / 10).toFixed(1)}°, azimuth ${(this.live.azimuth[k] / 10).toFixed(0)}°` : "free";
      const detail = place + bend + (this.faults[k] ? ` (${this.faults[k]})` : ", healthy");
      if (detail !== this.detail) this.detail = detail;
    },
  },
};
