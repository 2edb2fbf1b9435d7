// Two tunings side by side: parameters, gains, and their recordings over each other.

import { get } from "../api.js";
import { Chart } from "../chart.js";
import { h, moment, number, plusMinus, table } from "../dom.js";

export async function compareView(root, signal, ...ids) {
  const pair = await Promise.all(ids.map((id) => get(`/v1/tunings/${encodeURIComponent(id)}`, signal)));
  root.append(h("p", { class: "crumbs" }, h("a", { href: "#/tunings" }, "Tunings"), " /"), h("h1", {}, "Two tunings"));
  const heads = pair.map((tuning) => h("a", { href: `#/tunings/${tuning.id}` }, `${tuning.loop}, ${moment(tuning.started_at)}`));
  const names = [...new Set(pair.flatMap((tuning) => Object.keys(tuning.model ?? {})))];
  const value = (tuning, name) => {
    const interval = tuning.estimates?.[tuning.recommended]?.interval95?.[name];
    return tuning.model?.[name] === undefined ? "–" : plusMinus(tuning.model[name], interval ? (interval[1] - interval[0]) / 2 : NaN);
  };
  const row = (name, tell) => [name, ...pair.map(tell)];
  root.append(h("section", { class: "card" }, table("What both found", ["", ...heads], [
    row("Ended", (t) => h("span", { class: `badge ${t.verdict?.outcome ?? "running"}` }, t.verdict?.code ?? t.phase)),
    row("Structure", (t) => t.structure ?? "–"),
    ...names.map((name) => row(name, (t) => value(t, name))),
    row("Fit", (t) => (t.fit?.fit_percent ? `${number(t.fit.fit_percent, 3)} %` : "–")),
    row("Error where not fitted", (t) => number(t.error?.held_out, 3)),
    row("Period Pu, s", (t) => number(t.limit_cycle?.Pu)), row("Ultimate gain Ku", (t) => number(t.limit_cycle?.Ku)),
    ...["Kp", "Ti", "Td"].map((name) => row(name === "Kp" ? "Kp" : `${name}, s`, (t) => number(t.gains?.[name]))),
    row("Goal or rule", (t) => t.tuning?.goal ?? t.tuning?.rule ?? "–"), row("Ms", (t) => number(t.tuning?.margins?.Ms, 3)),
    row("Amplitude", (t) => number(t.limit_cycle?.h))])));
  const curves = await Promise.all(pair.map((tuning) => (tuning.samples > 1 ? get(`${tuning.links.self}/curves?most=1500`, signal) : null)));
  for (const [i, one] of curves.entries()) if (one) root.append(h("section", { class: "card" }, h("h2", {}, heads[i].textContent), picture(one)));
}

function picture(curves) {
  const chart = new Chart([
    { title: "PV", weight: 1.6, series: [{ key: "pv", label: "measured", colour: "--c-pv", kind: "dots" }, { key: "model", label: "model", colour: "--c-model" }] },
    { title: "output", series: [{ key: "output", label: "output", colour: "--c-output", kind: "step" }] }], { label: "Measured PV, model and output", height: 300 });
  chart.data = { t: curves.t_s, pv: curves.pv, model: curves.model, output: curves.output };
  chart.draw();
  return chart.element;
}
