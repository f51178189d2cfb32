// Keys for everything that is done often; none while something is being typed or asked.
const PAN = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };

export default {
  template: `<span class="hidden"></span>`,
  props: { mapId: Number, timeId: Number },
  mounted() {
    window.addEventListener("keydown", (event) => {
      if (event.ctrlKey || event.metaKey || event.altKey) return;
      if (event.target.closest("input:not([type=range]), textarea, select, .q-dialog")) return;
      const map = getElement(this.mapId);
      const time = getElement(this.timeId);
      const keys = {
        t: () => map.setMode("top"),
        p: () => map.setMode("3d"),
        f: () => map.setFollow(!map.follow),
        a: () => map.fit(),
        m: () => map.useTool("distance"),
        h: () => map.useTool("height"),
        w: () => map.useTool("waypoint"),
        l: () => map.useTool("localize"),
        "+": () => map.zoom(1.25),
        "=": () => map.zoom(1.25),
        "-": () => map.zoom(0.8),
        " ": () => time.play(),
        n: () => time.now(),
        ",": () => time.step(-1),
        ".": () => time.step(1),
        d: () => this.$emit("key", { key: "d" }),
        "?": () => this.$emit("key", { key: "?" }),
        Escape: () => map.clearTools(),
      };
      const onButton = event.target.closest("button, [role=button], input");
      if (onButton && (event.key === " " || event.key.startsWith("Arrow"))) return;
      const action = PAN[event.key] ? () => map.move(...PAN[event.key]) : keys[event.key];
      if (!action) return;
      event.preventDefault();
      action();
    });
  },
};
