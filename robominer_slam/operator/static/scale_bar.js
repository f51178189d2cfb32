// A bar of a round length in metres, at the distance of what the camera looks at.
const WIDEST = 160;

export function drawScaleBar(element, metresPerPixel) {
  const longest = WIDEST * metresPerPixel;
  const power = 10 ** Math.floor(Math.log10(longest));
  const length = [5, 2, 1].map((k) => k * power).find((value) => value <= longest) ?? power;
  const text = length >= 1 ? `${length} m` : `${Math.round(100 * length)} cm`;
  const width = `${Math.round(length / metresPerPixel)}px`;
  if (element.style.width !== width) element.style.width = width;
  if (element.textContent !== text) element.textContent = text;
}
