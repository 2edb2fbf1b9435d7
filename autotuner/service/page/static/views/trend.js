// The live trend of a loop: an hour of samples at most, whatever the sampling, so that memory does not grow.

import { Chart } from "../chart.js";

const KEPT_S = 3600;
const KEPT_SAMPLES = 72000;
const COLUMNS = ["t", "pv", "output", "sp"];

export class Trend {
  constructor(loop, height = 400) {
    this.loop = loop;
    this.columns = Object.fromEntries(COLUMNS.map((name) => [name, []]));
    const unit = (name, text) => (text ? `${name}, ${text}` : name);
    const { output, pv } = loop.limits;
    const limits = (pair, what) => (pair ?? []).map((value, i) => ({ value, label: `${i ? "highest" : "lowest"} ${what}` }));
    this.pvPanel = { title: unit("PV", loop.pv_unit), weight: 2.2, lines: limits(pv, "PV"), bands: [], series: [
      { key: "sp", label: "SP", colour: "--c-sp", kind: "step" },
      { key: "pv", label: "PV", colour: "--c-pv" }] };
    this.outputPanel = { title: unit("output", loop.output_unit), lines: limits(output, "output"), bands: [], series: [
      { key: "output", label: "output", colour: "--c-output", kind: "step" }] };
    this.chart = new Chart([this.pvPanel, this.outputPanel], { label: `Trend of loop ${loop.name}: PV above, output below`, height });
    [this.pvPanel, this.outputPanel] = this.chart.panels;
    this.chart.data = this.columns;
    this.element = this.chart.element;
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
