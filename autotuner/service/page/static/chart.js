// Charts over time on a canvas: panels one above the other with one time axis, phases shaded behind them.
//
// However many samples there are, a column of pixels draws its lowest and highest value only. The colours come from
// the style sheet, so light and dark need nothing here. A pointer reads values, a drag chooses a span of time, and a
// drag with the shift key, or of a finger, moves it; the keys are arrows, Page Up and Down, Home, End, +, - and 0.

import { lower, nearest, reading, ticks, timeOfDay, timeTicks } from "./axis.js";

const LEFT = 58;
/** Width of a picture under which times of day are without the hour, px. */
const NARROW = 420;
/** Shortest time that an axis of times of day shows, s: enough for three labels. */
const SHORTEST_CLOCK_S = 10;
const RIGHT = 12;
const TOP = 36;
const BOTTOM = 40;
const GAP = 24;
/** Factor of one step of zoom, share of the span of one step of a move, shortest drag that is a choice, px. */
const ZOOM = 2, MOVE = 0.25, DRAG = 8;
/** Most values of a series that is only near that are looked at. */
const MOST_NEAR = 20000;

export class Chart {
  /**
   * `panels`: [{title, weight, series: [{key, label, colour, kind: "line" | "step" | "dots", near}]}]; `label` is what a
   * screen reader is told the picture shows; a series that is only `near` widens no axis by more than a span. `areas` of a panel are {low, high, colour}: keys of a band's two edges.
   * `gap`: longest time between two samples that one line joins, s. `clock`: the axis shows the time of day, and `t` is
   * in seconds since the epoch. `plain`: without tools. `empty`: what a picture without data says.
   */
  constructor(panels, { label, height = 380, xTitle = "t, s", gap = Infinity, clock = false, plain = false, empty = "No data yet" } = {}) {
    Object.assign(this, { gap, clock, empty });
    this.panels = panels.map((panel) => ({ weight: 1, lines: [], bands: [], areas: [], ...panel }));
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
    this.bar = plain ? null : this.tools();
    if (this.bar) this.element.append(this.bar);
    this.wanted = 0;
    this.drag = null;
    new ResizeObserver(() => this.draw()).observe(this.element);
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.draw());
    this.canvas.addEventListener("pointerdown", (event) => this.press(event, plain));
    this.canvas.addEventListener("pointermove", (event) => this.movePointer(event));
    this.canvas.addEventListener("pointerup", () => this.release());
    this.canvas.addEventListener("pointercancel", () => { this.drag = null; this.draw(); });
    this.canvas.addEventListener("pointerleave", () => this.put(null));
    this.canvas.addEventListener("dblclick", () => this.show(null));
    this.canvas.addEventListener("keydown", (event) => this.key(event));
    this.canvas.addEventListener("blur", () => this.put(null));
  }

  /** Buttons that do what pointer and keys do; "All" shows the whole time again, and follows new samples. */
  tools() {
    const bar = document.createElement("div");
    bar.className = "tools";
    const acts = [["−", "Zoom out", () => this.zoom(ZOOM)], ["+", "Zoom in", () => this.zoom(1 / ZOOM)], ["◀", "Earlier", () => this.pan(-MOVE)], ["▶", "Later", () => this.pan(MOVE)], ["All", "Show all times", () => this.show(null)]];
    for (const [text, name, act] of acts) {
      const button = document.createElement("button");
      Object.assign(button, { type: "button", textContent: text, title: name });
      button.setAttribute("aria-label", name);
      button.addEventListener("click", act);
      bar.append(button);
    }
    return bar;
  }

  /** Show a span of time; null: all of it. */
  show(span) {
    this.window = span;
    this.draw();
  }

  zoom(factor) {
    if (!this.scale) return;
    const { from, to } = this.scale, [first, last] = this.whole();
    const middle = this.cursor === null ? (from + to) / 2 : this.data.t[this.cursor];
    const half = (factor * (to - from)) / 2;
    const span = [Math.max(first, middle - half), Math.min(last, middle + half)];
    this.show(span[0] <= first && span[1] >= last ? null : span);
  }

  pan(share) {
    if (!this.scale) return;
    const { from, to } = this.scale, [first, last] = this.whole();
    const by = Math.min(Math.max(share * (to - from), first - from), last - to);
    if (by) this.show([from + by, to + by]);
  }

  whole() {
    return [this.data.t[0] ?? 0, this.data.t.at(-1) ?? 1];
  }

  press(event, plain) {
    if (plain || event.button) return;
    const moves = event.shiftKey || (event.pointerType === "touch" && this.window);
    this.drag = { from: event.offsetX, to: event.offsetX, moves, touch: event.pointerType === "touch" };
    this.canvas.setPointerCapture(event.pointerId);
  }

  movePointer(event) {
    const { drag } = this;
    if (drag?.moves) this.pan((drag.to - event.offsetX) / this.scale.plot);
    if (drag) drag.to = event.offsetX;
    this.point(event.offsetX);
  }

  release() {
    const { drag } = this;
    this.drag = null;
    if (drag && !drag.moves && !drag.touch && Math.abs(drag.to - drag.from) > DRAG) this.show([drag.from, drag.to].sort((a, b) => a - b).map(this.scale.time));
    this.draw();
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
    const zooms = { "+": 1 / ZOOM, "=": 1 / ZOOM, "-": ZOOM };
    if (event.key in zooms || event.key === "0") {
      if (event.key === "0") this.show(null);
      else this.zoom(zooms[event.key]);
      return;
    }
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
    if (this.bar) this.bar.hidden = !this.data.t.length;
    if (!this.data.t.length) return this.paintEmpty(pen, width);
    this.layout(width);
    this.paintPhases(pen);
    this.paintTime(pen);
    for (const panel of this.panels) this.paintPanel(pen, panel);
    this.paintDrag(pen);
    this.paintCursor(pen);
    this.tell();
  }

  paintEmpty(pen, width) {
    pen.fillStyle = this.colour("--muted");
    pen.textAlign = "center";
    pen.font = `15px ${this.colours.fontFamily}`;
    pen.fillText(this.empty, width / 2, this.height / 2);
    this.readout.replaceChildren();
  }

  /** The span that a drag is about to choose. */
  paintDrag(pen) {
    if (!this.drag || this.drag.moves || this.drag.touch) return;
    pen.save();
    pen.globalAlpha = 0.15;
    pen.fillStyle = this.colour("--accent");
    pen.fillRect(this.drag.from, TOP, this.drag.to - this.drag.from, this.panels.at(-1).bottom - TOP);
    pen.restore();
  }

  colour(name) {
    return this.colours.getPropertyValue(name).trim() || name;
  }

  layout(width) {
    const t = this.data.t;
    let [from, to] = this.window ?? [t[0] ?? 0, t.at(-1) ?? 1];
    if (!(to > from)) to = from + 1;
    if (this.clock) from = Math.min(from, to - SHORTEST_CLOCK_S);
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
    for (const key of [...panel.series.filter((one) => !one.near).map((one) => one.key), ...panel.areas.flatMap((area) => [area.low, area.high])]) {
      const values = this.data[key] ?? [];
      for (let i = this.first; i < this.last; i += 1) if (values[i] !== null && Number.isFinite(values[i])) take(values[i]);
    }
    for (const band of panel.bands) [band.low, band.high].filter(Number.isFinite).forEach(take);
    if (!(high >= low)) [low, high] = [0, 1];
    const span = high - low || Math.max(Math.abs(high), 1) * 0.1;
    for (const { key } of panel.series.filter((one) => one.near)) {
      const values = (this.data[key] ?? []).slice(this.first, this.last).filter((value) => value !== null && Number.isFinite(value));
      const [least, most] = [Math.min(...values.slice(-MOST_NEAR)), Math.max(...values.slice(-MOST_NEAR))];
      if (values.length && least >= low - span && most <= high + span) [least, most].forEach(take);
    }
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
    for (const tick of ticks(panel.low, panel.high, Math.max(3, Math.floor((panel.bottom - panel.top) / 34)))) {
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
    for (const area of panel.areas) this.paintArea(pen, panel, area);
    for (const band of panel.bands) this.paintBand(pen, panel, band);
    for (const series of panel.series) this.paintSeries(pen, panel, series);
    pen.restore();
    for (const limit of panel.lines) this.paintLine(pen, panel, limit);
    pen.save();
    pen.fillStyle = this.colour("--text");
    pen.textAlign = "left";
    pen.fillText(panel.title, 2, panel.top - (panel === this.panels[0] ? 22 : 12));
    pen.restore();
  }

  paintBand(pen, panel, band) {
    if (!Number.isFinite(band.low) || !Number.isFinite(band.high)) return;
    const left = Math.max(LEFT, this.scale.x(band.from ?? this.scale.from));
    const right = Math.min(LEFT + this.scale.plot, this.scale.x(band.to ?? this.scale.to));
    pen.fillStyle = this.colour(band.colour ?? "--band");
    pen.fillRect(left, panel.y(band.high), right - left, Math.max(1, panel.y(band.low) - panel.y(band.high)));
  }

  /** The surface between two series. */
  paintArea(pen, panel, { low, high, colour = "--band-pv" }) {
    const rows = [];
    for (let i = this.first; i < this.last; i += 1) if (Number.isFinite(this.data[low]?.[i]) && Number.isFinite(this.data[high]?.[i]) && this.data[low][i] !== null) rows.push(i);
    pen.beginPath();
    for (const i of rows) pen.lineTo(this.scale.x(this.data.t[i]), panel.y(this.data[high][i]));
    for (const i of rows.reverse()) pen.lineTo(this.scale.x(this.data.t[i]), panel.y(this.data[low][i]));
    pen.closePath();
    pen.fillStyle = this.colour(colour);
    pen.fill();
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
    let column = -1, low = 0, high = 0, end = 0, drawing = false, before = NaN;
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
      const none = value === null || value === undefined || !Number.isFinite(value);
      if (none || this.data.t[i] - before > this.gap) {
        flush();
        column = -1;
        drawing = false;
        if (none) continue;
      }
      before = this.data.t[i];
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
    const most = Math.max(3, Math.floor(plot / 90));
    for (const tick of this.clock ? timeTicks(from, to, most, plot < NARROW) : ticks(from, to, most)) {
      for (const panel of this.panels) line(pen, x(tick.value), panel.top, x(tick.value), panel.bottom);
      pen.textAlign = x(tick.value) > LEFT + plot - 20 ? "right" : "center";
      pen.fillText(tick.text, Math.min(x(tick.value), LEFT + plot + RIGHT - 2), bottom + 6);
    }
    pen.textAlign = "right";
    pen.fillText(this.xTitle, LEFT + plot, bottom + 22);
    pen.restore();
  }

  paintCursor(pen) {
    if (this.cursor === null || this.cursor >= this.data.t.length) return;
    const x = this.scale.x(this.data.t[this.cursor]);
    pen.save();
    pen.strokeStyle = this.colour("--text");
    pen.globalAlpha = 0.5;
    line(pen, x, TOP, x, this.panels.at(-1).bottom);
    pen.globalAlpha = 1;
    pen.textBaseline = "middle";
    pen.textAlign = x > LEFT + this.scale.plot / 2 ? "right" : "left";
    const side = x > LEFT + this.scale.plot / 2 ? -8 : 8;
    for (const panel of this.panels) this.paintReadings(pen, panel, x, side);
    pen.restore();
  }

  /** The values at the cursor beside it, one under the other, each with a dot on its line. */
  paintReadings(pen, panel, x, side) {
    const shown = panel.series.filter(({ key }) => Number.isFinite(this.data[key]?.[this.cursor]) && this.data[key][this.cursor] !== null);
    shown.forEach(({ key, colour, label }, row) => {
      const value = this.data[key][this.cursor], text = `${label ? `${label} ` : ""}${reading(value)}`, y = panel.top + 8 + 15 * row;
      const wide = pen.measureText(text).width + 6;
      pen.fillStyle = this.colour("--card");
      pen.globalAlpha = 0.85;
      pen.fillRect(side < 0 ? x + side - wide + 3 : x + side - 3, y - 7, wide, 14);
      pen.globalAlpha = 1;
      pen.fillStyle = this.colour(colour);
      pen.fillText(text, x + side, y);
      pen.beginPath();
      pen.arc(x, panel.y(value), 3.5, 0, 7);
      pen.fill();
    });
  }

  /** The legend, with the values at the cursor, or the latest. */
  tell() {
    const entries = this.panels.flatMap((panel) => panel.series.filter(({ key, label }) => label && this.data[key]?.some((v) => v !== null && Number.isFinite(v))));
    const shows = (at) => entries.some(({ key }) => this.data[key]?.[at] !== null && Number.isFinite(this.data[key]?.[at]));
    let index = this.cursor ?? this.data.t.length - 1;
    while (this.cursor === null && index > 0 && !shows(index)) index -= 1;
    if (this.readout.childElementCount !== entries.length + 1) {
      this.readout.replaceChildren(...["t", ...entries].map(() => document.createElement("span")));
    }
    const [time, ...spans] = this.readout.children;
    const t = this.data.t[index];
    const [name, unit = ""] = this.xTitle.split(", ");
    time.textContent = this.clock ? timeOfDay(t) : `${name} ${reading(t)} ${unit}`.trimEnd();
    entries.forEach(({ key, label, colour }, i) => {
      spans[i].className = `key ${colour.slice(2)}`;
      spans[i].textContent = `${label} ${reading(this.data[key][index])}`;
    });
  }
}

function line(pen, x0, y0, x1, y1) {
  pen.beginPath();
  pen.moveTo(Math.round(x0) + 0.5, Math.round(y0) + 0.5);
  pen.lineTo(Math.round(x1) + 0.5, Math.round(y1) + 0.5);
  pen.stroke();
}
