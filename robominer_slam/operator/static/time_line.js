// The session's time: now, or a moment of the past; and playing on from there.
import { stream } from "robominer-console";

const STEP_MS = 100;
const SPEEDS = [1, 4, 16];

export default {
  template: `
    <div class="time-line" data-testid="time-line" role="group" aria-label="Time">
      <button @click="play()" :aria-pressed="playing" title="Play from here (space)">{{ playing ? "❚❚" : "▶" }}</button>
      <button class="speed" @click="nextSpeed()" title="Speed of playing">{{ speed }}×</button>
      <span class="time" data-testid="time-shown">{{ shownText }}</span>
      <input type="range" min="0" :max="length" :value="at" step="100" aria-label="Moment of the session" @input="seek(Number($event.target.value))">
      <span class="time">{{ format(length) }}</span>
      <button class="now" :aria-pressed="past===null" @click="now()" title="Back to now (N)" data-testid="now">{{ recording ? "End" : "Live" }}</button>
    </div>`,
  data() {
    return { first: 0, last: 0, past: null, playing: false, speed: 1, recording: false };
  },
  computed: {
    length() {
      return Math.max(0, this.last - this.first);
    },
    at() {
      return this.past === null ? this.length : this.past - this.first;
    },
    shownText() {
      const clock = new Date(this.first + this.at).toLocaleTimeString("en-GB");
      return this.recording || this.first === 0 ? this.format(this.at) : clock;
    },
  },
  mounted() {
    stream.on("live", ({ span }) => {
      // Two seconds are fine enough for a slider, and cost the page little.
      if (span[0] !== this.first || Math.abs(span[1] - this.last) > 1000) [this.first, this.last] = span;
    });
    stream.on("readings", ({ progress }) => (this.recording = progress !== null));
  },
  methods: {
    format(ms) {
      const seconds = Math.floor(ms / 1000);
      return `${Math.floor(seconds / 60)}:${String(seconds % 60).padStart(2, "0")}`;
    },
    seek(at) {
      this.past = this.first + Math.min(Math.max(at, 0), this.length);
      document.body.dataset.past = "true";
      stream.seek(Math.round(this.past));
      this.$emit("seek", { stamp: Math.round(this.past) });
    },
    now() {
      this.past = null;
      this.pause();
      delete document.body.dataset.past;
      stream.seek(null);
      this.$emit("seek", { stamp: null });
    },
    step(seconds) {
      this.seek(this.at + 1000 * seconds);
    },
    play() {
      if (this.playing) return this.pause();
      if (this.past === null || this.at >= this.length) this.seek(0);
      this.playing = true;
      this.timer = setInterval(() => {
        if (this.at >= this.length) return this.recording ? this.pause() : this.now();
        this.seek(this.at + STEP_MS * this.speed);
      }, STEP_MS);
    },
    pause() {
      this.playing = false;
      clearInterval(this.timer);
    },
    nextSpeed() {
      this.speed = SPEEDS[(SPEEDS.indexOf(this.speed) + 1) % SPEEDS.length];
    },
  },
};
