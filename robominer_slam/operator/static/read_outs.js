// Writes the stream's figures into every element that names one by `data-field`; only what has changed.
import { stream } from "robominer-console";

const STATE_LEVELS = { tracking: "good", dead_reckoning: "fair", relocalizing: "fair", lost: "bad", "": "none" };
const LINK_WORDS = { none: "waiting for the robot", live: "live", recording: "recording" };

/** Figures are written so often, ms: faster ones cannot be read. */
const WRITE_MS = 100;

function write(field, text) {
  for (const element of document.querySelectorAll(`[data-field="${field}"]`)) if (element.textContent !== text) element.textContent = text;
}

function list(selector, rows) {
  const element = document.querySelector(selector);
  const text = JSON.stringify(rows);
  if (!element || element.dataset.content === text) return;
  element.dataset.content = text;
  element.replaceChildren(...rows.map(([level, ...cells]) => {
    const row = document.createElement("li");
    row.dataset.level = level;
    row.append(...cells.map((cell) => Object.assign(document.createElement("span"), { textContent: cell })));
    return row;
  }));
}

export default {
  template: `<span class="hidden"></span>`,
  mounted() {
    let frames = 0;
    setInterval(() => {
      write("rate_page", `${stream.stats.frames - frames} Hz`);
      frames = stream.stats.frames;
      if (stream.stats.latency !== null) write("latency_page", `${Math.round(stream.stats.latency)} ms`);
    }, 1000);
    let writtenAt = 0;
    stream.on("live", ({ place, state, past }) => {
      const now = performance.now();
      if (now - writtenAt < WRITE_MS && !past) return;
      writtenAt = now;
      for (const [field, text] of Object.entries(place)) write(field, text);
      document.body.dataset.state = STATE_LEVELS[state] ?? "none";
      document.body.dataset.showing = past ? "past" : "now";
    });
    stream.on("readings", ({ fields, faults, devices, events, paused, progress }) => {
      for (const [field, text] of Object.entries(fields)) write(field, text);
      write("fault_count", faults.length === 0 ? "no faults" : faults.length === 1 ? "1 fault" : `${faults.length} faults`);
      document.body.dataset.faults = faults.length ? "some" : "none";
      document.body.dataset.paused = paused;
      list("#faults", faults.map((text) => ["bad", text]));
      list("#devices", devices.map(([name, text, level]) => [level === "0" ? "good" : "bad", name, text]));
      list("#events", [...events].reverse().map(([stamp, text]) => ["none", new Date(stamp).toLocaleTimeString("en-GB"), text]));
      if (progress !== null) LINK_WORDS.recording = progress < 1 ? `reading ${Math.round(100 * progress)} %` : "recording";
      write("link", LINK_WORDS[document.body.dataset.link] ?? document.querySelector('[data-field="link"]')?.textContent ?? "");
    });
    stream.on("link", ({ state, age, heard, console }) => {
      const silent = console === false ? "no answer from the console" : age === null ? "no data" : `no ${heard ? "poses" : "data"} for ${(age / 1000).toFixed(1)} s`;
      write("link", LINK_WORDS[state] ?? silent);
    });
  },
};
