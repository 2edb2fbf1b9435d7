// A verification: live while it runs, with its picture afterwards: gains written, the step, the predicted band, the verdict.

import { follow } from "../api.js";
import { Chart } from "../chart.js";
import { duration, facts, fill, h, moment, number, table } from "../dom.js";
import { ABORT, stop } from "./live.js";

const PHASES = ["write", "settle", "rest", "predict", "step", "restore"];
const WORDS = {
  write: "writing the gains", settle: "controller takes over", rest: "waiting for rest", predict: "computing the band", step: "step", restore: "restoring", ended: "ended",
};
const TITLES = { true: "Verified: the loop did as predicted", false: "Not verified: the loop did not do as predicted" };

/** The card of a verification that has ended; null where there was none. */
export function verificationCard(result, units) {
  if (!result) return null;
  const outcome = { ...result, at: result.ended_at };
  return h("section", { class: "card", "aria-label": "Verification", "data-verification": String(result.passed) }, h("h2", {}, "Verification"), verdictOf(outcome),
    facts([["Step of the set point", result.step === null ? "–" : `${number(result.step)} ${units.pv}`], ["Judged for", duration(result.duration_s ?? NaN)],
      ["Overshoot, measured", percent(result.overshoot)], ["Overshoot, predicted", percent(result.predicted_overshoot)],
      result.actor && ["Started by", result.actor], result.ended_at && ["Ended", moment(result.ended_at)]]),
    gainsTable(result.gains), result.response.length > 1 ? picture(result, units).element : null);
}

const percent = (share) => (Number.isFinite(share) && share !== null ? `${number(100 * share, 2)} %` : "–");

function verdictOf({ passed, rolled_back: back, verdict, message, remedy }) {
  return h("div", { class: `notice ${passed ? "done" : "failed"}`, role: "status", "data-verified": String(passed) }, h("strong", {}, TITLES[String(passed)]),
    h("p", {}, `${verdict?.message ?? message ?? ""}. ${verdict?.remedy ?? remedy ?? ""}`.replace("..", ".").trim()), back ? h("p", {}, "The gains before are in the device again.") : null);
}

function gainsTable(gains) {
  if (!gains) return null;
  return table(`Gains in the device (${gains.form})`, ["", "Before", "Written", "Read back"], Object.keys(gains.written).map((name) => [name, ...["before", "written", "read_back"].map((part) => number(gains[part][name], 6))]));
}

/** PV and output after the step over the predicted band; times from the step. */
function picture({ response, predicted, predicted_output: play, step, rest }, units) {
  const unit = (name, text) => (text ? `${name}, ${text}` : name);
  const chart = new Chart([
    { title: unit("PV", units.pv), weight: 2, areas: [{ low: "low", high: "high" }], lines: rest && step ? [{ value: rest.pv + step, label: "set point", colour: "--c-sp" }] : [], series: [{ key: "pv", label: "PV", colour: "--c-pv" }] },
    { title: unit("output", units.output), areas: [{ low: "least", high: "most", colour: "--band" }], series: [{ key: "output", label: "output", colour: "--c-output", kind: "step" }] }],
  { label: "PV and output after the step, over the band that was predicted", height: 340, empty: "Waiting for the step" });
  const at = (rows, times, column) => times.map((t) => interpolated(rows, t, column));
  const set = (rows) => {
    const times = [...new Set([...rows.map((row) => row[0]), ...predicted.map((row) => row[0])])].sort((a, b) => a - b);
    const found = new Map(rows.map((row) => [row[0], row]));
    chart.data = { t: times, pv: joined(times, found, 1), output: joined(times, found, 2), low: at(predicted, times, 1), high: at(predicted, times, 2), least: at(play, times, 1), most: at(play, times, 2) };
    chart.draw();
  };
  set(response);
  return { element: chart.element, set };
}

/** A column at all times: between two samples the value before, so that the line of the samples is not broken. */
function joined(times, found, column) {
  const last = Math.max(-Infinity, ...found.keys());
  let value = null;
  return times.map((t) => { value = found.get(t)?.[column] ?? value; return t > last ? null : value; });
}

function interpolated(rows, t, column) {
  const after = rows.findIndex((row) => row[0] >= t);
  if (after < 0 || !rows.length || t < rows[0][0]) return null;
  const [b, a] = [rows[after], rows[Math.max(0, after - 1)]];
  return b[0] === a[0] ? b[column] : a[column] + ((b[column] - a[column]) * (t - a[0])) / (b[0] - a[0]);
}

/** Follow the running verification of a tuning in `place` until it has ended. */
export async function followVerification(place, tuning, units, signal) {
  const seen = { phase: "write", since: 0, t: 0, expected: NaN, step: null, rows: [], ended: null };
  const phases = h("ol", { class: "phases", "aria-label": "Phases of the verification" }, PHASES.map((name) => h("li", { "data-step": name }, WORDS[name])));
  const trouble = h("div", {}), numbers = h("div", {}), gains = h("div", {}), drawn = h("div", {}), verdict = h("div", {});
  const abort = h("button", { class: "abort", onclick: () => stop(tuning, abort, trouble) }, ABORT);
  fill(place, h("section", { class: "card", "aria-label": "Verification", "data-verification": "running" },
    h("div", { class: "row" }, h("h2", {}, "Verification"), abort), phases, verdict, trouble, numbers, drawn, gains));
  const takers = {
    verification_phase(event) { Object.assign(seen, { phase: event.phase, since: event.t, t: event.t, expected: event.expected_s ?? NaN }); if (event.phase === "restore") abort.disabled = true; },
    gains_written(event) { fill(gains, gainsTable(event)); },
    sample(event) { seen.t = event.t; seen.latest = event; if (seen.step) seen.rows.push([event.t - seen.step.t, event.pv, event.output]); },
    step_made(event) { seen.step = event; seen.picture = picture({ response: [], predicted: event.predicted, predicted_output: event.predicted_output, step: event.step, rest: { pv: event.rest_pv } }, units); fill(drawn, seen.picture.element); },
    verification_ended(event) { seen.ended = event; abort.disabled = true; fill(verdict, verdictOf(event)); },
  };
  const refresh = () => { markPhases(phases, seen.phase); fill(numbers, facts(running(seen, units))); seen.picture?.set(seen.rows); };
  refresh();
  await follow(tuning.links.verification_events, (events) => { for (const event of events) takers[event.type]?.(event); refresh(); }, (stands) => fill(trouble, stands ? null : h("p", { class: "notice bad", role: "alert" }, "The connection to the service was lost; the page connects again. The verification goes on by itself.")), signal, "verification_ended");
  return seen.ended;
}

function markPhases(list, phase) {
  const order = PHASES.indexOf(phase === "ended" ? "restore" : phase);
  [...list.children].forEach((item, at) => { item.className = at === order && phase !== "ended" ? "now" : at <= order ? "past" : ""; });
}

function running({ phase, since, t, expected, step, latest }, units) {
  const left = expected - (t - since);
  return [
    ["Phase", WORDS[phase]], ["Elapsed", duration(Math.floor(t))], ["Left in this phase", left > 0 ? duration(Math.ceil(left)) : phase === "ended" ? "–" : "soon"],
    latest && ["PV", `${number(latest.pv, 5)} ${units.pv}`], latest && ["Output", `${number(latest.output, 5)} ${units.output}`],
    step && ["Step of the set point", `by ${number(step.step)} to ${number(step.set_point, 5)} ${units.pv}`]];
}
