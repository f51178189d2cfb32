// Height colours that people with any colour vision can order: viridis and cividis, at eleven steps each.
export const COLOUR_MAPS = {
  viridis: ["#440154", "#482475", "#414487", "#355f8d", "#2a788e", "#21918c", "#22a884", "#44bf70", "#7ad151", "#bddf26", "#fde725"],
  cividis: ["#00224e", "#123570", "#3b496c", "#575d6d", "#707173", "#8a8678", "#a59c74", "#c3b369", "#e1cc55", "#f6df4c", "#fee838"],
};

/** Okabe and Ito's colours, which stay apart for everyone; by theme where they need contrast. */
export function sceneColours(dark) {
  return dark
    ? { background: "#0d1319", grid: "#26323d", body: "#7c8b99", path: "#e6edf3", keyframe: "#9fb3c4", closure: "#cc79a7", free: "#8fa3b5", contact: "#ff9d2e", fault: "#ff5d5d", ellipse: "#56b4e9", tool: "#ffffff" }
    : { background: "#dfe5ea", grid: "#c3ccd4", body: "#3d4b58", path: "#17212b", keyframe: "#42566a", closure: "#a8226c", free: "#60748a", contact: "#c65300", fault: "#c00020", ellipse: "#0072b2", tool: "#000000" };
}

export function gradient(name) {
  return `linear-gradient(to top, ${COLOUR_MAPS[name].join(", ")})`;
}

/** RGBA bytes of 256 colours along a map. */
export function colourBytes(name) {
  const steps = COLOUR_MAPS[name].map((hex) => [1, 3, 5].map((k) => parseInt(hex.slice(k, k + 2), 16)));
  const bytes = new Uint8Array(256 * 4);
  for (let i = 0; i < 256; i++) {
    const at = (i / 255) * (steps.length - 1);
    const low = Math.min(Math.floor(at), steps.length - 2);
    for (let k = 0; k < 3; k++) bytes[4 * i + k] = Math.round(steps[low][k] + (at - low) * (steps[low + 1][k] - steps[low][k]));
    bytes[4 * i + 3] = 255;
  }
  return bytes;
}
