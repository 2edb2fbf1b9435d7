// Charts over time on a canvas: panels one above the other with one time axis, phases shaded behind them.
//
// However many samples there are, a column of pixels draws its lowest and highest value only. The colours come from
// the style sheet, so light and dark need nothing here. Arrow keys move the cursor as a pointer does.

const LEFT = 58;
const RIGHT = 12;
const TOP = 36;
const BOTTOM = 26;
const GAP = 24;

export class Chart {
  /**
   * `panels`: [{title, weight, series: [{key, label, colour, kind: "line" | "step" | "dots"}]}]; `label` is what a
   * screen reader is told the picture shows.
   */
  constructor(panels, { label, height = 380, xTitle = "t, s" } = {}) {
    this.panels = panels.map((panel) => ({ weight: 1, lines: [], bands: [], ...panel }));
    this.data = { t: [] };
    this.phases = [];
    this.height = height;
    this.xTitle = xTitle;
    this.cursor = null;
    this.window = null;
    this.canvas = document.createElement("canvas");
    this.canvas.tabIndex = 0;
    this.canvas.setAttribute("role", "img");
    this.canvas.setAttribute("aria-label", label);
    this.readout = document.createElement("div");
    this.readout.className = "readout";
    this.element = document.createElement("figure");
    this.element.className = "chart";
    this.element.append(this.canvas, this.readout);
    this.wanted = 0;
    new ResizeObserver(() => this.draw()).observe(this.element);
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.draw());
    this.canvas.addEventListener("pointermove", (event) => this.point(event.offsetX));
    this.canvas.addEventListener("pointerleave", () => this.put(null));
    this.canvas.addEventListener("keydown", (event) => this.key(event));
    this.canvas.addEventListener("blur", () => this.put(null));
  }

  /** Draw with the next picture of the screen, however often it is asked for. */
  draw() {
    if (!this.wanted) this.wanted = requestAnimationFrame(() => this.paint());
  }

  point(x) {
    if (!this.scale || !this.data.t.length) return;
    this.put(nearest(this.data.t, this.scale.time(x)));
  }

  key(event) {
    const size = this.data.t.length;
    const steps = { ArrowLeft: -1, ArrowRight: 1, PageUp: -50, PageDown: 50, Home: -size, End: size };
    if (!(event.key in steps) || !size) return;
    event.preventDefault();
    const from = this.cursor ?? size - 1;
    this.put(Math.min(size - 1, Math.max(0, from + steps[event.key])));
  }

  put(index) {
    this.cursor = index;
    this.draw();
  }

  paint() {
    this.wanted = 0;
    const width = this.element.clientWidth;
    if (!width) return;
    const ratio = window.devicePixelRatio || 1;
    const canvas = this.canvas;
    if (canvas.width !== Math.round(width * ratio) || canvas.height !== Math.round(this.height * ratio)) {
      canvas.width = Math.round(width * ratio);
      canvas.height = Math.round(this.height * ratio);
      canvas.style.width = `${width}px`;
      canvas.style.height = `${this.height}px`;
    }
    const pen = canvas.getContext("2d");
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    pen.clearRect(0, 0, width, this.height);
    this.colours = getComputedStyle(this.element);
    pen.font = `11px ${this.colours.fontFamily}`;
    this.layout(width);
    this.paintPhases(pen);
    this.paintTime(pen);
    for (const panel of this.panels) this.paintPanel(pen, panel);
    this.paintCursor(pen);
    this.tell();
  }

  colour(name) {
    return this.colours.getPropertyValue(name).trim() || name;
  }

  layout(width) {
    const t = this.data.t;
    let [from, to] = this.window ?? [t[0] ?? 0, t.at(-1) ?? 1];
    if (!(to > from)) to = from + 1;
    const plot = width - LEFT - RIGHT;
    this.scale = {
      width, plot, from, to,
      x: (time) => LEFT + ((time - from) / (to - from)) * plot,
      time: (x) => from + ((x - LEFT) / plot) * (to - from),
    };
    this.first = Math.max(0, lower(t, from) - 1);
    this.last = Math.min(t.length, lower(t, to) + 1);
    const weights = this.panels.reduce((sum, panel) => sum + panel.weight, 0);
    const room = this.height - TOP - BOTTOM - GAP * (this.panels.length - 1);
    let top = TOP;
    for (const panel of this.panels) {
      panel.top = top;
      panel.bottom = top + (room * panel.weight) / weights;
      top = panel.bottom + GAP;
      Object.assign(panel, this.range(panel));
      const span = panel.high - panel.low;
      panel.y = (value) => panel.bottom - ((value - panel.low) / span) * (panel.bottom - panel.top);
    }
  }

  range(panel) {
    let low = Infinity;
    let high = -Infinity;
    const take = (value) => {
      if (value < low) low = value;
      if (value > high) high = value;
    };
    for (const { key } of panel.series) {
      const values = this.data[key] ?? [];
      for (let i = this.first; i < this.last; i += 1) if (values[i] !== null && Number.isFinite(values[i])) take(values[i]);
    }
    for (const band of panel.bands) [band.low, band.high].filter(Number.isFinite).forEach(take);
    if (!(high >= low)) [low, high] = [0, 1];
    const span = high - low || Math.max(Math.abs(high), 1) * 0.1;
    for (const line of panel.lines) if (line.value >= low - span && line.value <= high + span) take(line.value);
    const edge = 0.08 * (high - low || span);
    return { low: low - edge, high: high + edge };
  }

  paintPhases(pen) {
    const { x, from, to } = this.scale;
    const bottom = this.panels.at(-1).bottom;
    pen.textAlign = "left";
    pen.textBaseline = "alphabetic";
    for (const phase of this.phases) {
      const begin = Math.max(phase.from, from);
      const end = Math.min(phase.to ?? to, to);
      if (end <= begin) continue;
      pen.globalAlpha = 1;
      pen.fillStyle = this.colour(`--phase-${phase.name}`);
      pen.fillRect(x(begin), TOP, x(end) - x(begin), bottom - TOP);
      const wide = pen.measureText(phase.label).width;
      if (x(end) - x(begin) > wide + 6) {
        pen.fillStyle = this.colour("--muted");
        pen.fillText(phase.label, x(begin) + 3, TOP - 6);
      }
    }
  }

  paintPanel(pen, panel) {
    const { plot } = this.scale;
    pen.save();
    pen.textAlign = "right";
    pen.textBaseline = "middle";
    pen.lineWidth = 1;
    for (const tick of ticks(panel.low, panel.high, Math.max(2, Math.floor((panel.bottom - panel.top) / 34)))) {
      pen.strokeStyle = this.colour("--grid");
      line(pen, LEFT, panel.y(tick.value), LEFT + plot, panel.y(tick.value));
      pen.fillStyle = this.colour("--muted");
      pen.fillText(tick.text, LEFT - 6, panel.y(tick.value));
    }
    pen.restore();
    pen.save();
    pen.beginPath();
    pen.rect(LEFT, panel.top, plot, panel.bottom - panel.top);
    pen.clip();
    for (const band of panel.bands) this.paintBand(pen, panel, band);
    for (const series of panel.series) this.paintSeries(pen, panel, series);
    pen.restore();
    for (const limit of panel.lines) this.paintLine(pen, panel, limit);
    pen.save();
    pen.fillStyle = this.colour("--text");
    pen.textAlign = "left";
    pen.fillText(panel.title, 2, panel.top - (panel === this.panels[0] ? 22 : 8));
    pen.restore();
  }

  paintBand(pen, panel, band) {
    if (!Number.isFinite(band.low) || !Number.isFinite(band.high)) return;
    const left = Math.max(LEFT, this.scale.x(band.from ?? this.scale.from));
    const right = Math.min(LEFT + this.scale.plot, this.scale.x(band.to ?? this.scale.to));
    pen.fillStyle = this.colour(band.colour ?? "--band");
    pen.fillRect(left, panel.y(band.high), right - left, Math.max(1, panel.y(band.low) - panel.y(band.high)));
  }

  paintLine(pen, panel, { value, label, colour = "--limit" }) {
    if (!Number.isFinite(value)) return;
    const y = panel.y(value);
    if (y < panel.top - 1 || y > panel.bottom + 1) return;
    pen.save();
    pen.strokeStyle = pen.fillStyle = this.colour(colour);
    pen.setLineDash([5, 4]);
    line(pen, LEFT, y, LEFT + this.scale.plot, y);
    pen.textAlign = "right";
    pen.textBaseline = y - panel.top > 14 ? "bottom" : "top";
    pen.fillText(label, LEFT + this.scale.plot - 4, y - (y - panel.top > 14 ? 2 : -2));
    pen.restore();
  }

  paintSeries(pen, panel, { key, colour, kind = "line" }) {
    const values = this.data[key];
    if (!values) return;
    pen.strokeStyle = pen.fillStyle = this.colour(colour);
    pen.lineWidth = kind === "step" ? 1.4 : 1.6;
    pen.lineJoin = "round";
    if (kind === "dots") return this.paintDots(pen, panel, values);
    pen.beginPath();
    let column = -1, low = 0, high = 0, end = 0, drawing = false;
    const flush = () => {
      if (column < 0) return;
      if (low !== high) {
        pen.lineTo(column, panel.y(low));
        pen.lineTo(column, panel.y(high));
      }
      pen.lineTo(column, panel.y(end));
    };
    for (let i = this.first; i < this.last; i += 1) {
      const value = values[i];
      if (value === null || value === undefined || !Number.isFinite(value)) {
        flush();
        column = -1;
        drawing = false;
        continue;
      }
      const x = Math.round(this.scale.x(this.data.t[i]) * 2) / 2;
      if (x !== column) {
        flush();
        if (!drawing) pen.moveTo(x, panel.y(value));
        else if (kind === "step") pen.lineTo(x, panel.y(end));
        column = x;
        low = high = value;
        drawing = true;
      }
      low = Math.min(low, value);
      high = Math.max(high, value);
      end = value;
    }
    flush();
    pen.stroke();
  }

  paintDots(pen, panel, values) {
    pen.globalAlpha = 0.55;
    const size = this.last - this.first > 2000 ? 1.4 : 2.2;
    let lastX = -9, lastY = -9;
    for (let i = this.first; i < this.last; i += 1) {
      if (values[i] === null || !Number.isFinite(values[i])) continue;
      const x = Math.round(this.scale.x(this.data.t[i]) * 2) / 2;
      const y = Math.round(panel.y(values[i]) * 2) / 2;
      if (x !== lastX || y !== lastY) pen.fillRect(x - size / 2, y - size / 2, size, size);
      lastX = x;
      lastY = y;
    }
    pen.globalAlpha = 1;
  }

  paintTime(pen) {
    const { x, from, to, plot } = this.scale;
    const bottom = this.panels.at(-1).bottom;
    pen.save();
    pen.fillStyle = this.colour("--muted");
    pen.strokeStyle = this.colour("--grid");
    pen.textBaseline = "top";
    pen.textAlign = "center";
    for (const tick of ticks(from, to, Math.max(2, Math.floor(plot / 90)))) {
      for (const panel of this.panels) line(pen, x(tick.value), panel.top, x(tick.value), panel.bottom);
      if (x(tick.value) < LEFT + plot - 34) pen.fillText(tick.text, x(tick.value), bottom + 6);
    }
    pen.textAlign = "right";
    pen.fillText(this.xTitle, LEFT + plot, bottom + 6);
    pen.restore();
  }

  paintCursor(pen) {
    if (this.cursor === null || this.cursor >= this.data.t.length) return;
    const x = this.scale.x(this.data.t[this.cursor]);
    pen.save();
    pen.strokeStyle = this.colour("--text");
    pen.globalAlpha = 0.5;
    line(pen, x, TOP, x, this.panels.at(-1).bottom);
    pen.restore();
  }

  /** The legend, with the values at the cursor, or the latest. */
  tell() {
    const index = this.cursor ?? this.data.t.length - 1;
    const entries = this.panels.flatMap((panel) => panel.series.filter(({ key, label }) => label && this.data[key]?.some((v) => v !== null && Number.isFinite(v))));
    if (this.readout.childElementCount !== entries.length + 1) {
      this.readout.replaceChildren(...["t", ...entries].map(() => document.createElement("span")));
    }
    const [time, ...spans] = this.readout.children;
    const show = (value) => (value === null || !Number.isFinite(value) ? "–" : Number(value.toPrecision(5)).toString());
    time.textContent = `${this.xTitle.split(",")[0]} ${show(this.data.t[index] ?? NaN)}`;
    entries.forEach(({ key, label, colour }, i) => {
      spans[i].className = `key ${colour.slice(2)}`;
      spans[i].textContent = `${label} ${show(this.data[key][index] ?? NaN)}`;
    });
  }
}

function line(pen, x0, y0, x1, y1) {
  pen.beginPath();
  pen.moveTo(Math.round(x0) + 0.5, Math.round(y0) + 0.5);
  pen.lineTo(Math.round(x1) + 0.5, Math.round(y1) + 0.5);
  pen.stroke();
}

/** Round numbers between two, at most so many, with texts of equal precision. */
export function ticks(low, high, most) {
  const raw = (high - low) / most;
  const power = 10 ** Math.floor(Math.log10(raw));
  const step = [1, 2, 5, 10].map((factor) => factor * power).find((candidate) => candidate >= raw * 0.999);
  const decimals = Math.min(12, Math.max(0, -Math.floor(Math.log10(step) + 1e-9)));
  const found = [];
  for (let k = Math.ceil(low / step - 1e-9); k * step <= high + 1e-9 * step; k += 1) {
    const value = k * step;
    found.push({ value, text: Math.abs(value) >= 1e6 ? value.toExponential(1) : value.toFixed(decimals) });
  }
  return found;
}

/** Index of the first time not below `value`. */
export function lower(times, value) {
  let low = 0, high = times.length;
  while (low < high) {
    const middle = (low + high) >> 1;
    if (times[middle] < value) low = middle + 1;
    else high = middle;
  }
  return low;
}

function nearest(times, value) {
  const after = Math.min(times.length - 1, lower(times, value));
  return after > 0 && value - times[after - 1] < times[after] - value ? after - 1 : after;
}
