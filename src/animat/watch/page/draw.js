// Canvases in the page's colours: a frame with numbered axes, and what is drawn in it.

let style = null;

export function colour(name) {
  style ??= getComputedStyle(document.documentElement);
  return style.getPropertyValue(`--${name}`).trim();
}

matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => { style = null; });

// For ordered values such as frequencies: from blue to yellow, distinguishable with any colour vision.
export function ordered(i, n) {
  const ramp = colour("ramp").split(" ");
  const at = (n < 2 ? 1 : i / (n - 1)) * (ramp.length - 1);
  const low = Math.min(Math.floor(at), ramp.length - 2), share = at - low;
  const [a, b] = [ramp[low], ramp[low + 1]].map((hex) => [1, 3, 5].map((k) => parseInt(hex.slice(k, k + 2), 16)));
  return `rgb(${a.map((x, k) => Math.round(x + share * (b[k] - x))).join(",")})`;
}

const SERIES = ["blue", "orange", "green", "purple", "sky", "red"];

export function series(i) {
  return colour(SERIES[i % SERIES.length]);
}

const MINUS = "\u2212";

export function shown(value, digits = 4) {
  if (value === null || value === undefined || !Number.isFinite(value)) return "not known";
  if (Number.isInteger(value) && Math.abs(value) < 1e15) return value.toLocaleString("en").replace("-", MINUS);
  const text = Math.abs(value) >= 1e-4 || value === 0 ? Number(value.toPrecision(digits)).toLocaleString("en", { maximumFractionDigits: 12 }) : value.toExponential(2);
  return text.replace("-", MINUS);
}

// A few round numbers within a span.
function marks(low, high, most) {
  const raw = (high - low) / Math.max(1, most);
  if (!(raw > 0) || !Number.isFinite(raw)) return [low];
  const unit = 10 ** Math.floor(Math.log10(raw));
  const steps = [0.2, 0.5, 1, 2, 5, 10].map((k) => k * unit);
  let which = steps.findIndex((each) => each >= raw * 0.999), found = multiples(steps[which], low, high);
  // A single number does not show the scale.
  while (found.length < 2 && which > 0) found = multiples(steps[which -= 1], low, high);
  return found;
}

function multiples(step, low, high) {
  const found = [];
  for (let i = Math.ceil(low / step - 1e-9); i * step <= high + 1e-9 * step; i += 1) found.push(Number((i * step).toPrecision(12)));
  return found;
}

const sheet = document.createElement("canvas").getContext("2d", { willReadFrequently: true });

// A canvas with a frame: x and y are spans in units.
export class Frame {
  constructor(canvas, x, y, options = {}) {
    const ratio = window.devicePixelRatio || 1, width = canvas.clientWidth, height = canvas.clientHeight;
    if (canvas.width !== Math.round(width * ratio) || canvas.height !== Math.round(height * ratio)) {
      canvas.width = Math.round(width * ratio);
      canvas.height = Math.round(height * ratio);
    }
    const g = canvas.getContext("2d");
    g.setTransform(ratio, 0, 0, ratio, 0, 0);
    g.clearRect(0, 0, width, height);
    g.font = "12px system-ui, 'DejaVu Sans', sans-serif";
    if (Math.abs(y[1] - y[0]) < 1e-12) y = [y[0] - 1, y[1] + 1];
    Object.assign(this, { g, x, y, width, height });
    const yMarks = options.yMarks ?? marks(Math.min(...y), Math.max(...y), Math.max(2, Math.floor(height / 45)));
    const labels = options.yLabels ?? yMarks.map((each) => shown(each, 6));
    this.left = options.left ?? Math.min(width / 3, 8 + Math.max(18, ...labels.map((each) => g.measureText(each).width)));
    this.right = width - (options.right ?? 8);
    this.top = options.top ?? 6;
    this.bottom = height - 34;
    this.#axes(yMarks, labels, options);
  }

  #axes(yMarks, labels, options) {
    const { g } = this;
    Object.assign(g, { lineWidth: 1, textBaseline: "middle", textAlign: "right", fillStyle: colour("faint") });
    yMarks.forEach((each, i) => {
      const at = this.atY(each);
      if (at < this.top - 1 || at > this.bottom + 1) return;
      if (!options.yLabels) this.#rule(this.left, at, this.right, at, colour("grid"));
      g.fillText(labels[i], this.left - 5, Math.max(at, 7));
    });
    Object.assign(g, { textBaseline: "top", textAlign: "center" });
    for (const each of marks(this.x[0], this.x[1], Math.max(2, Math.floor((this.right - this.left) / 70)))) {
      const at = this.atX(each), half = g.measureText(shown(each, 6)).width / 2;
      if (at < this.left - 1 || at > this.right + 1 || (options.isCounted && !Number.isInteger(each))) continue;
      this.#rule(at, this.bottom, at, this.bottom + 3, colour("faint"));
      g.fillText(shown(each, 6), Math.min(at, this.width - half - 1), this.bottom + 5);
    }
    g.fillText(options.xLabel, (this.left + this.right) / 2, this.bottom + 20);
    g.strokeStyle = colour("line");
    g.strokeRect(this.left + 0.5, this.top + 0.5, this.right - this.left - 1, this.bottom - this.top - 1);
  }

  #rule(x0, y0, x1, y1, stroke) {
    const { g } = this;
    g.strokeStyle = stroke;
    g.beginPath();
    g.moveTo(Math.round(x0) + 0.5, Math.round(y0) + 0.5);
    g.lineTo(Math.round(x1) + 0.5, Math.round(y1) + 0.5);
    g.stroke();
  }

  atX(value) { return this.left + ((value - this.x[0]) / (this.x[1] - this.x[0] || 1)) * (this.right - this.left); }

  atY(value) { return this.bottom - ((value - this.y[0]) / (this.y[1] - this.y[0] || 1)) * (this.bottom - this.top); }

  // Joins points, clipped to the frame; null breaks the line. With steps, each value holds until the next.
  line(xs, ys, stroke, { steps = false, width = 1.6, dashes = [] } = {}) {
    const { g } = this;
    g.save();
    g.beginPath();
    g.rect(this.left, this.top, this.right - this.left, this.bottom - this.top);
    g.clip();
    Object.assign(g, { strokeStyle: stroke, lineWidth: width, lineJoin: "round" });
    g.setLineDash(dashes);
    g.beginPath();
    let pen = false, lastY = 0;
    xs.forEach((x, i) => {
      if (x === null || ys[i] === null || ys[i] === undefined) { pen = false; return; }
      const at = [this.atX(x), this.atY(ys[i])];
      if (pen && steps) g.lineTo(at[0], lastY);
      if (pen) g.lineTo(...at); else g.moveTo(...at);
      lastY = at[1];
      pen = true;
    });
    g.stroke();
    g.restore();
  }

  dot(x, y, fill, { radius = 3, ring = false } = {}) {
    const { g } = this;
    const edge = Math.max(Math.min(...this.y), Math.min(Math.max(...this.y), y));
    g.beginPath();
    g.arc(this.atX(x), this.atY(edge), radius, 0, 2 * Math.PI);
    if (ring) { g.strokeStyle = fill; g.lineWidth = 1.5; g.stroke(); } else { g.fillStyle = fill; g.fill(); }
  }

  // Spikes at times of 0 to 65,535 within x, set as pixels of a sheet: drawing thousands of rectangles kept a core busy.
  spikes(times, channels, n) {
    const ratio = window.devicePixelRatio || 1;
    const width = Math.max(1, Math.round((this.right - this.left) * ratio)), height = Math.max(1, Math.round((this.bottom - this.top) * ratio));
    const wide = Math.max(1, Math.round(1.2 * ratio)), high = Math.max(1, Math.round(Math.min(2.5 * ratio, height / Math.max(n, 1))));
    const image = new ImageData(width, height), pixels = new Uint32Array(image.data.buffer);
    const [red, green, blue] = [1, 3, 5].map((k) => parseInt(colour("ink").slice(k, k + 2), 16));
    new Uint8Array(pixels.buffer, 0, 4).set([red, green, blue, 255]);
    const ink = pixels[0];
    pixels[0] = 0;
    for (let i = 0; i < times.length; i += 1) {
      const x = Math.min(width - wide, Math.floor((times[i] / 65535) * width));
      const y = Math.max(0, Math.min(height - high, Math.round((this.atY(channels[i]) - this.top) * ratio - high / 2)));
      for (let row = y; row < y + high; row += 1) pixels.fill(ink, row * width + x, row * width + x + wide);
    }
    sheet.canvas.width = width;
    sheet.canvas.height = height;
    sheet.putImageData(image, 0, 0);
    this.g.drawImage(sheet.canvas, this.left, this.top, width / ratio, height / ratio);
  }

  text(words, x, y, fill) {
    Object.assign(this.g, { fillStyle: fill, textAlign: "left", textBaseline: "middle" });
    this.g.fillText(words, x, y);
  }
}

// The smallest span that holds all values, with a margin.
export function spanOf(values, least = 1e-9) {
  const known = values.filter((each) => each !== null && Number.isFinite(each));
  if (!known.length) return [0, 1];
  let low = Infinity, high = -Infinity;
  for (const each of known) { low = Math.min(low, each); high = Math.max(high, each); }
  // A single value gets a margin too: an axis with ten equal numbers is useless.
  const more = Math.max((high - low) * 0.06, least, Math.abs(high) * (high > low ? 1e-6 : 0.1));
  return [low - more, high + more];
}

export function unpacked(base64) {
  const text = atob(base64), bytes = new Uint8Array(text.length);
  for (let i = 0; i < text.length; i += 1) bytes[i] = text.charCodeAt(i);
  return new Uint16Array(bytes.buffer);
}

export function make(name, properties = {}, ...children) {
  const made = Object.assign(document.createElement(name), properties);
  made.append(...children);
  return made;
}

export function list(target, pairs) {
  target.replaceChildren(...pairs.flatMap(([name, value]) => [make("dt", { textContent: name }), make("dd", { textContent: value })]));
}

export function listColours(target, entries) {
  target.replaceChildren(...entries.map(([name, stroke, className = ""]) => {
    const mark = make("i", { className });
    mark.style.color = stroke;
    return make("span", {}, mark, name);
  }));
}

// Numbers are right-aligned, texts left-aligned; "none yet" is aligned like the numbers of its column.
export function table(target, head, rows) {
  const isText = head.map((_, i) => rows.some((row) => /[a-z]{3}/i.test(row[i]) && !/^(none|not)\b/.test(row[i])));
  const line = (cells, kind) => make("tr", {}, ...cells.map((each, i) => make(kind, { textContent: each.replaceAll(" %", "\u00a0%"), className: isText[i] ? "text" : "" })));
  target.replaceChildren(make("thead", {}, line(head, "th")), make("tbody", {}, ...rows.map((row) => line(row, "td"))));
}
