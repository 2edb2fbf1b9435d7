// What a tuning or a recording told: model, picture, gains of every goal.

import { Chart } from "../chart.js";
import { facts, h, number, plusMinus, table } from "../dom.js";
import { acting } from "./loop.js";

/** Names of effects in one phrase. */
export const listed = (names) => names.map((name) => name.replaceAll("_", " ")).join(" and ");

const STRUCTURES = {
  fopdt: "first order with dead time", sopdt_overdamped: "second order with dead time, overdamped", sopdt_underdamped: "second order with dead time, underdamped",
  integrating: "integrating with dead time", unstable_fopdt: "unstable, first order with dead time", inverse_response: "inverse response with dead time", inverse_response_underdamped: "inverse response beside a damped pair",
  n_lags: "equal lags with dead time", third_order: "third order with dead time", third_order_underdamped: "third order with a damped pair and dead time",
};
export const METHODS = { least_squares: "least squares", closed_form: "closed form", describing_function: "describing function", learned: "learned correction", diagnosis: "with the effect of the diagnosis" };
const MEANING = { K: "static gain", D: "dead time", T: "time constant", T1: "longer time constant", T2: "shorter time constant", T3: "shortest time constant", m: "coefficient of s²", n: "coefficient of s", L: "lead time", Tz: "time of the zero" };

export function unitOf(name, structure, units) {
  const gain = units.pv || units.output ? `${units.pv || "PV"}/${units.output || "output"}` : "PV/output";
  if (name === "K") return structure === "integrating" ? `${gain}/s` : gain;
  if (name === "n" && structure === "n_lags") return "";
  return name === "m" ? "s²" : "s";
}

/** The box that says how it ended, in words. */
export function verdictBox(verdict) {
  const words = { done: "Done", refused: "Refused", aborted: "Aborted", failed: "Failed" };
  return h("div", { class: `notice ${verdict.outcome}`, role: "status", "data-verdict": verdict.outcome },
    h("strong", {}, words[verdict.outcome] ?? verdict.outcome), h("p", {}, verdict.message), verdict.remedy ? h("p", {}, verdict.remedy) : null);
}

/** What the reader has to know, in one box. */
export function remarks(texts) {
  if (!texts.length) return null;
  if (texts.length === 1) return h("p", { class: "notice warn" }, texts[0]);
  return h("div", { class: "notice warn" }, h("strong", {}, "Warnings"), h("ul", {}, texts.map((text) => h("li", {}, text))));
}

/** The recommended model with intervals, and what the other methods say. */
export function modelCard(result, units) {
  if (!result.model) return null;
  const best = result.estimates?.[result.recommended] ?? {};
  const names = Object.keys(result.model);
  const half = (name) => (best.interval95?.[name] ? (best.interval95[name][1] - best.interval95[name][0]) / 2 : NaN);
  const meaning = result.structure === "n_lags" ? { ...MEANING, n: "number of lags" } : MEANING;
  const rows = names.map((name) => [name, meaning[name] ?? "", plusMinus(result.model[name], half(name), unitOf(name, result.structure, units)),
    best.interval95?.[name] ? `${number(best.interval95[name][0])} to ${number(best.interval95[name][1])}` : "–"]);
  const methods = Object.values(result.estimates ?? {}).map((estimate) => [
    METHODS[estimate.method] ?? estimate.method,
    estimate.model ? Object.entries(estimate.model).map(([name, value]) => `${name} ${number(value)}`).join(", ") : h("span", { class: "muted" }, estimate.refusal ?? "does not apply"),
    Number.isFinite(estimate.fit_percent) ? `${number(estimate.fit_percent, 3)} %` : "–"]);
  const cycle = result.limit_cycle;
  const pv = units.pv ? ` ${units.pv}` : "";
  return h("section", { class: "card", "aria-label": "Model" },
    h("h2", {}, `Model: ${STRUCTURES[result.structure] ?? result.structure}`),
    table("Value with half of its 95 % interval", ["", "", "Value", "95 % interval"], rows),
    facts([
      ["Fit", `${number(result.fit?.fit_percent, 3)} %`], ["Error, root mean square", `${number(result.fit?.rmse, 3)}${pv}`], ["Noise, standard deviation", `${number(result.fit?.noise_sigma, 3)}${pv}`],
      result.error && ["Error where not fitted", `${number(result.error.held_out, 3)}${pv}`],
      cycle && ["Period Pu", `${number(cycle.Pu)} s`], cycle && ["Amplitude A", `${number(cycle.A)}${pv}`], cycle && ["Ultimate gain Ku", `${number(cycle.Ku)} ${units.output || "output"}/${units.pv || "PV"}`]]),
    h("details", {}, h("summary", {}, "Estimates of each method"), table("Parameters by method", ["Method", "Parameters", "Fit"], methods)));
}

const SEGMENTS = { relay: "relay", half_relay: "check", staircase: "check", tail: "check" };

/** Measured against model, the output, and the residual; the model is the process without the effects, by name, `beside` it. */
export function fitCard(curves, units, beside = []) {
  const unit = (name, text) => (text ? `${name}, ${text}` : name);
  const panels = [
    { title: unit("PV", units.pv), weight: 2.4, series: [
      { key: "sp", label: "SP", colour: "--c-sp", kind: "step", near: true }, { key: "pv", label: "measured", colour: "--c-pv", kind: "dots" }, { key: "model", label: "model", colour: "--c-model" }] },
    { title: unit("output", units.output), series: [{ key: "output", label: "output", colour: "--c-output", kind: "step" }] }];
  if (curves.residual) panels.push({ title: unit("residual", units.pv), series: [{ key: "residual", label: "residual", colour: "--c-residual" }] });
  const { relay_reference: reference, hysteresis, segments } = curves.settings ?? {};
  if (Number.isFinite(reference) && hysteresis > 0) panels[0].bands = [{ low: reference - hysteresis, high: reference + hysteresis, from: segments?.relay, to: segments?.half_relay, colour: "--band-pv" }];
  const chart = new Chart(panels, { label: "Measured PV against the model, the output, and the residual", height: curves.residual ? 460 : 360 });
  chart.data = { t: curves.t_s, pv: curves.pv, model: curves.model, output: curves.output, residual: curves.residual, sp: curves.set_point };
  chart.phases = segmentsOf(curves);
  chart.draw();
  return h("section", { class: "card", "aria-label": "Measured against model" }, h("h2", {}, curves.model ? "Measured against model" : "Recording"), chart.element,
    beside.length ? h("p", { class: "small muted" }, `The model here is the process alone, without ${listed(beside)}.`) : null,
    h("p", { class: "small muted" }, "Point at the picture for values; drag over it to zoom, double-click to see all. Keys: arrows, +, −, 0."));
}

function segmentsOf(curves) {
  const parts = Object.entries(curves.settings?.segments ?? {}).sort((a, b) => a[1] - b[1]);
  return parts.map(([name, from], i) => ({ name: SEGMENTS[name] ?? "relay", label: name.replaceAll("_", " "), from, to: parts[i + 1]?.[1] ?? curves.t_s.at(-1) }));
}

const GAINS_HEAD = ["Goal", "", "Kp", "Ti", "Td", "Ms", "Gain margin", "Phase margin", "Overshoot", "Settling time", "IAE of a load", "Output movement"];

function gainsRow(choice, units) {
  const { gains } = choice.device ?? choice, { margins, predicted } = choice;
  const percent = (share) => (Number.isFinite(share) && share !== null ? `${number(100 * share, 2)} %` : "–");
  return [choice.name, gains.controller, number(gains.Kp), gains.Ti === null ? "–" : `${number(gains.Ti)} s`, gains.Td ? `${number(gains.Td)} s` : "–",
    number(margins?.Ms, 3), number(margins?.gain_margin, 3), margins?.phase_margin_deg ? `${number(margins.phase_margin_deg, 3)}°` : "–",
    percent(predicted?.overshoot ?? choice.overshoot), Number.isFinite(predicted?.settling_time_s) && predicted.settling_time_s !== null ? `${number(predicted.settling_time_s, 3)} s` : "–", number(choice.iae, 3),
    Number.isFinite(choice.jitter) && choice.jitter !== null ? `${number(choice.jitter, 2)} ${units.output}` : "–"];
}

/** The gains of every goal: ideal form, the device's own numbers, margins, predicted responses. */
export function gainsCard(choices, units) {
  const held = choices.filter((choice) => choice.device);
  const device = held.length ? table(`As the device states them: ${held[0].device.form} form, ${acting(held[0].device)}`, ["", ...Object.keys(held[0].device.values)],
    held.map((choice) => [choice.name, ...Object.values(choice.device.values).map((value) => number(value, 5))])) : null;
  return h("section", { class: "card", "aria-label": "Gains" }, h("h2", {}, "Gains of every goal"),
    table("Ideal form, by goal", GAINS_HEAD, choices.map((choice) => gainsRow(choice, units))),
    h("p", { class: "small muted" }, heldBy(choices)), device, responses(choices, units));
}

/** The controller that margins, overshoot and responses are predicted for. */
function heldBy(choices) {
  const gains = (choices[0]?.device ?? choices[0])?.gains;
  if (!gains) return "";
  const filters = [gains.N && `a derivative filter Td/${number(gains.N, 3)}`, gains.Tf && `a measurement filter Tf ${number(gains.Tf, 3)} s`].filter(Boolean);
  return `Predicted for ${choices[0].device ? "the controller in the device" : "a controller that holds the whole design"}: set-point weight b ${number(gains.b, 3)}, ${filters.join(" and ") || "no filter"}. Settling time: to within 2 % of the step. Output movement: standard deviation that measured noise and resolution cause.`;
}

function responses(choices, units) {
  const colours = ["calm", "balanced", "brisk"];
  const unit = (name, text) => (text ? `${name}, ${text}` : name);
  const told = choices[0]?.responses ?? {};
  const size = (value, text) => `${number(value)}${text && ` ${text}`}`;
  const pictures = [["step", `Step of the set point by ${size(told.set_point_step, units.pv)}`, "The PV follows the set point"], ["load", `Step of the load by ${size(told.load_step, units.output)}`, "The PV after a load"]];
  const beside = told.effects?.length ? h("p", { class: "small muted" }, `Predicted with ${listed(told.effects)}, as the diagnosis found it.`) : null;
  return h("div", {}, beside, h("div", { class: "split even" }, pictures.map(([what, title, label]) => {
    const series = (part) => choices.map((choice) => ({ key: `${choice.name}_${part}`, label: part === "pv" ? choice.name : "", colour: `--c-${colours.includes(choice.name) ? choice.name : "rule"}` }));
    const chart = new Chart([{ title: unit("PV", units.pv), weight: 1.5, series: series("pv") }, { title: unit("output", units.output), series: series("output") }], { label, height: 290 });
    chart.data = { t: choices[0]?.responses.t_s ?? [] };
    for (const choice of choices) for (const part of ["pv", "output"]) chart.data[`${choice.name}_${part}`] = choice.responses[`${what}_${part}`];
    chart.draw();
    return h("div", {}, h("h3", {}, title), chart.element);
  })));
}
