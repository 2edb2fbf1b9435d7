// Two tunings side by side: parameters, gains, and their recordings over each other.

import { get } from "../api.js";
import { Chart } from "../chart.js";
import { h, moment, number, plusMinus, table } from "../dom.js";
import { unitOf } from "./result.js";

export async function compareView(root, signal, ...ids) {
  const pair = await Promise.all(ids.map((id) => get(`/v1/tunings/${encodeURIComponent(id)}`, signal)));
  root.append(h("p", { class: "crumbs" }, h("a", { href: "#/tunings" }, "History"), " /"), h("h1", {}, "Comparison of two tunings"));
  const heads = pair.map((tuning, i) => h("a", { href: `#/tunings/${tuning.id}` }, `${i ? "Second" : "First"}: ${tuning.loop}, ${moment(tuning.started_at)}`));
  const names = [...new Set(pair.flatMap((tuning) => Object.keys(tuning.model ?? {})))];
  const value = (tuning, name) => {
    const interval = tuning.estimates?.[tuning.recommended]?.interval95?.[name];
    return tuning.model?.[name] === undefined ? "–" : plusMinus(tuning.model[name], interval ? (interval[1] - interval[0]) / 2 : NaN, unitOf(name, tuning.structure, {}));
  };
  const row = (name, tell) => [name, ...pair.map(tell)];
  root.append(h("section", { class: "card" }, table("Results", ["", ...heads], [
    row("Ended", (t) => h("span", { class: `badge ${t.verdict?.outcome ?? "running"}` }, t.verdict?.code ?? t.phase)),
    row("Structure", (t) => t.structure ?? "–"),
    ...names.map((name) => row(name, (t) => value(t, name))),
    row("Fit", (t) => (t.fit?.fit_percent ? `${number(t.fit.fit_percent, 3)} %` : "–")),
    row("Error where not fitted", (t) => number(t.error?.held_out, 3)),
    row("Period Pu, s", (t) => number(t.limit_cycle?.Pu)), row("Ultimate gain Ku", (t) => number(t.limit_cycle?.Ku)),
    ...["Kp", "Ti", "Td"].map((name) => row(name === "Kp" ? "Kp" : `${name}, s`, (t) => number(t.gains?.[name]))),
    row("Goal or rule", (t) => t.tuning?.goal ?? t.tuning?.rule ?? "–"), row("Ms", (t) => number(t.tuning?.margins?.Ms, 3)),
    row("Settling time, predicted", (t) => seconds(t.tuning?.predicted?.settling_time_s)), row("Overshoot, predicted", (t) => share(t.tuning?.predicted?.overshoot)),
    row("Output movement", (t) => number(t.tuning?.jitter, 2)), row("Started by", (t) => t.actor),
    row("Gains in the device", (t) => (t.applied ? "applied" : "not applied")), row("Verification", (t) => (t.verification ? (t.verification.passed ? "passed" : "not passed") : "none")),
    row("Amplitude", (t) => number(t.limit_cycle?.h)),
    row("Diagnosis", (t) => (t.diagnosis ? [t.diagnosis.verdict, ...t.diagnosis.effects.map((effect) => effect.name.replaceAll("_", " "))].join(": ") : "–"))], { class: "wrapped" })));
  const curves = await Promise.all(pair.map((tuning) => (tuning.samples > 1 ? get(`${tuning.links.self}/curves?most=1500`, signal) : null)));
  if (curves.every(Boolean)) root.append(h("section", { class: "card", "aria-label": "Both recordings" }, h("h2", {}, "Both recordings, from the start of the relay"), overlaid(curves, ["first", "second"])));
}

const seconds = (value) => (Number.isFinite(value) && value !== null ? `${number(value, 3)} s` : "–");
const share = (value) => (Number.isFinite(value) && value !== null ? `${number(100 * value, 2)} %` : "–");
const SECOND = { pv: "--c-output", output: "--c-sp" };

/** Both recordings over one time axis: the times of both, each series where it has a sample. */
function overlaid(curves, names) {
  const shifted = curves.map((one) => one.t_s.map((t) => t - (one.settings?.segments?.relay ?? one.t_s[0])));
  const order = shifted.flatMap((times, which) => times.map((t, index) => ({ t, which, index }))).sort((a, b) => a.t - b.t);
  const last = [{}, {}];
  const data = { t: order.map((one) => one.t) };
  for (const what of ["pv", "output"]) for (const which of [0, 1]) {
    last[which][what] = null;
    data[`${what}${which}`] = order.map((one) => { if (one.which === which) last[which][what] = curves[which][what][one.index]; return one.t > shifted[which].at(-1) ? null : last[which][what]; });
  }
  const series = (what, kind, first) => [0, 1].map((which) => ({ key: `${what}${which}`, label: `${what} of the ${names[which]}`, colour: which ? SECOND[what] : first, kind }));
  const chart = new Chart([{ title: "PV", weight: 1.6, series: series("pv", "line", "--c-pv") }, { title: "output", series: series("output", "step", "--c-residual") }], { label: "PV and output of both tunings", height: 360 });
  chart.data = data;
  chart.draw();
  return chart.element;
}
