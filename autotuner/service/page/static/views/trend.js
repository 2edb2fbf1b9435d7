// The trend of a loop: an hour of samples at most, whatever the sampling, so that memory does not grow.

import { Chart } from "../chart.js";

const KEPT_S = 3600;
const KEPT_SAMPLES = 72000;
const COLUMNS = ["t", "pv", "output", "sp"];
/** Readings of an idle loop come every second or two, s; longer without one is a gap. */
const IDLE_GAP_S = 6;
/** Height of everything beside the trend on the first screen, px, and the least and greatest height of a trend. */
const BESIDE = 470, LEAST = 230, GREATEST = 460;

/** Height of a trend that leaves room for state and buttons on the first screen. */
export const onFirstScreen = () => Math.max(LEAST, Math.min(GREATEST, window.innerHeight - BESIDE));

export class Trend {
  /** `idle`: of a loop that nobody tunes, over the time of day; else of a test, over the time from its start. */
  constructor(loop, { height = onFirstScreen(), idle = false, plain = false } = {}) {
    this.loop = loop;
    this.columns = Object.fromEntries(COLUMNS.map((name) => [name, []]));
    const unit = (name, text) => (text ? `${name}, ${text}` : name);
    const { output, pv } = loop.limits;
    const limits = (pair, what) => (pair ?? []).map((value, i) => ({ value, label: `${i ? "highest" : "lowest"} ${what}` }));
    const panels = [
      { title: unit("PV", loop.pv_unit), weight: 2, lines: limits(pv, "PV"), series: [{ key: "sp", label: "SP", colour: "--c-sp", kind: "step", near: true }, { key: "pv", label: "PV", colour: "--c-pv" }] },
      { title: unit("output", loop.output_unit), lines: limits(output, "output"), series: [{ key: "output", label: "output", colour: "--c-output", kind: "step" }] }];
    const times = idle ? { clock: true, gap: IDLE_GAP_S, xTitle: "time of day", empty: "Waiting for the first reading" } : { gap: Math.max(1, 5 * loop.sample_time_s), empty: "Waiting for the first sample" };
    this.chart = new Chart(panels, { label: `Trend of loop ${loop.name}: PV above, output below`, height, plain, ...times });
    [this.pvPanel, this.outputPanel] = this.chart.panels;
    this.chart.data = this.columns;
    this.element = this.chart.element;
  }

  /** What the picture says while it has no data. */
  empty(text) {
    this.chart.empty = text;
    this.chart.draw();
  }

  add({ t, pv, output, set_point: sp }) {
    const { columns } = this;
    if (columns.t.length && t <= columns.t.at(-1)) return;
    columns.t.push(t);
    columns.pv.push(pv ?? null);
    columns.output.push(output ?? null);
    columns.sp.push(sp ?? null);
    if (columns.t.length > KEPT_SAMPLES || t - columns.t[0] > KEPT_S * 1.02) this.forget(t);
    this.chart.draw();
  }

  forget(now) {
    let gone = Math.max(0, this.columns.t.length - Math.floor(KEPT_SAMPLES * 0.98));
    while (now - this.columns.t[gone] > KEPT_S) gone += 1;
    for (const name of COLUMNS) this.columns[name].splice(0, gone);
    this.chart.cursor = null;
  }

  phase(name, t) {
    const open = this.chart.phases.at(-1);
    if (open && open.to === undefined) open.to = t;
    if (name !== "ended") this.chart.phases.push({ name, label: name, from: t });
    this.chart.draw();
  }

  /** Widen the relay's band to an output that was seen. */
  swing(output, from) {
    const [band] = this.outputPanel.bands;
    if (!band) this.outputPanel.bands = [{ low: output, high: output, from }];
    else Object.assign(band, { low: Math.min(band.low, output), high: Math.max(band.high, output) });
  }

  /** The two levels of the relay and its dead zone, as a recording's settings tell them. */
  relay({ relay_low: low, relay_high: high, relay_reference: reference, hysteresis }, from) {
    if (Number.isFinite(low)) this.outputPanel.bands = [{ low, high, from }];
    if (Number.isFinite(reference) && hysteresis > 0) this.pvPanel.bands = [{ low: reference - hysteresis, high: reference + hysteresis, from, colour: "--band-pv" }];
    this.chart.draw();
  }

  bandsEnd(t) {
    for (const band of [...this.pvPanel.bands, ...this.outputPanel.bands]) band.to ??= t;
  }
}
