// The diagnosis: what the model lacks, and error, process and gains before and after.

import { Chart } from "../chart.js";
import { h, number, plusMinus, table } from "../dom.js";
import { listed, unitOf } from "./result.js";

const LOOKS = { adequate: "done", explained: "refused", partly_explained: "failed", unexplained: "failed" };
const TITLES = { adequate: "Adequate: nothing is missing that this record can show", explained: "Explained: the record shows physics that the model lacks", partly_explained: "Partly explained: the effects below are hypotheses; model and gains are those without them", unexplained: "Unexplained: something is missing, and no known effect accounts for it" };
const PARTS = { fitted: "part that was fitted", selection: "part that chose the explanation", held_out: "part kept for the test" };
const MARGINS = { Ms: "Ms", gain_margin: "gain margin", phase_margin_deg: "phase margin, °" };

const words = (name) => name.replaceAll("_", " ");
const capital = (text) => text.charAt(0).toUpperCase() + text.slice(1);

/** The card of a diagnosis as the service tells it; null where there is none. */
export function diagnosisCard(diagnosis, units) {
  if (!diagnosis) return null;
  return h("section", { class: "card", "aria-label": "Diagnosis", id: "diagnosis" }, h("h2", {}, "Diagnosis: what the model lacks"),
    h("div", { class: `notice ${LOOKS[diagnosis.verdict]}`, "data-diagnosis": diagnosis.verdict }, h("strong", {}, TITLES[diagnosis.verdict]), h("p", {}, `${capital(diagnosis.summary)}.`)),
    diagnosis.effects.map((effect) => found(effect, units, diagnosis.verdict === "explained" ? "" : "Nearest, and not enough: ")),
    diagnosis.effects.length ? runnerUp(diagnosis.runner_up, units) : null,
    h("div", { class: diagnosis.effects.length ? "split even" : "" }, errors(diagnosis.error, units), diagnosis.effects.length ? before(diagnosis, units) : null),
    (diagnosis.notes ?? []).length ? h("ul", { class: "small" }, diagnosis.notes.map((note) => h("li", {}, `${capital(note.replace(/\.$/, ""))}.`))) : null);
}

/** What the gains shown rest on, where the diagnosis has a better process: its gains beside them. */
export function otherGains({ diagnosis, model }) {
  const after = diagnosis?.model?.after, gains = diagnosis?.gains?.after?.gains;
  if (diagnosis?.verdict !== "explained" || !gains || !model || Object.keys(model).every((name) => Math.abs(after[name] - model[name]) <= 1e-9 * Math.abs(model[name]))) return null;
  const names = listed(diagnosis.effects.map(({ name }) => name));
  const given = ["Kp", "Ti", "Td"].filter((name) => gains[name]).map((name) => `${name} ${number(gains[name])}${name === "Kp" ? "" : " s"}`).join(", ");
  return h("p", { class: "notice refused" }, `These gains follow from the model without ${names}. With it, those of the goal ${diagnosis.gains.after.goal} are ${given}.`);
}

/** One line for the head of a result: what was found, and where to read on. */
export function diagnosisLine(diagnosis) {
  if (!diagnosis || diagnosis.verdict === "adequate") return null;
  const names = listed(diagnosis.effects.map(({ name }) => name));
  const text = diagnosis.verdict === "explained" ? `The record shows ${names}, which the model lacks: ${diagnosis.summary}. ` : "The record shows something that no known effect accounts for. ";
  const jump = (event) => { event.preventDefault(); document.getElementById("diagnosis")?.scrollIntoView({ behavior: "smooth" }); };
  return h("p", { class: `notice ${LOOKS[diagnosis.verdict]}` }, text, h("a", { href: location.hash, onclick: jump }, "To the diagnosis"));
}

/** A unit in terms of "output" and "PV" in those of the loop. */
const inUnits = (unit, units) => (unit ?? "").replaceAll("output", units.output || "output").replaceAll("PV", units.pv || "PV");

function found(effect, units, before) {
  const sizes = Object.entries(effect.parameters).map(([name, value]) => {
    const [low, high] = effect.interval95[name] ?? [];
    const unit = inUnits(effect.units?.[name], units);
    return [unit ? `${words(name)}, ${unit}` : words(name), number(value), Number.isFinite(low) && Number.isFinite(high) ? `${number(low)} to ${number(high)}` : "not known"];
  });
  return h("div", { class: "effect", "data-effect": effect.name },
    h("h3", {}, capital(before + words(effect.name)) + (effect.form ? `, ${effect.form}` : ""), " ", h("span", { class: "badge" }, effect.place), " ",
      Number.isFinite(effect.confidence) ? h("span", { class: "badge" }, `confidence ${number(100 * Math.min(effect.confidence, 0.999), 3)} %`) : null),
    effect.advice ? h("p", {}, `${capital(effect.advice)}.`) : null,
    effect.indistinguishable.length ? h("p", { class: "notice warn" }, `This record cannot tell it from ${effect.indistinguishable.map(words).join(", ")}.`) : null,
    sizes.length ? table(`Size of ${words(effect.name)}`, ["", "Value", "95 % interval"], sizes) : null);
}

function runnerUp(next, units) {
  if (!next?.effects?.length) return null;
  const unit = units.pv ? ` ${units.pv}` : "";
  return h("p", { class: "small muted" }, `Next best: ${next.effects.map((effect) => words(effect.name)).join(" with ")}, with an error of ${number(next.held_out, 3)}${unit} on the part that was not fitted.`);
}

function errors(parts, units) {
  const sigmas = (value, noise) => (noise > 0 ? ` (${number(value / noise, 2)} σ)` : "");
  const rows = Object.entries(parts).map(([part, { before: first, after, noise }]) => [PARTS[part] ?? words(part), number(first, 3) + sigmas(first, noise), number(after, 3) + sigmas(after, noise), number(noise, 3)]);
  return table(`Error, root mean square${units.pv ? `, ${units.pv}` : ""}; σ: of the noise`, ["", "Before", "After", "Noise"], rows);
}

function before({ model, gains }, units) {
  const first = model.before ?? {}, last = model.after ?? {};
  const names = [...new Set([...Object.keys(first), ...Object.keys(last)])].filter((name) => name !== "structure" && name !== "interval95");
  const half = (name) => (last.interval95?.[name] ? (last.interval95[name][1] - last.interval95[name][0]) / 2 : NaN);
  const shown = (value, width) => (Number.isFinite(value) ? plusMinus(value, width) : "–");
  const controller = (side, name) => side?.gains?.[name];
  const rows = [
    ["Process", words(first.structure ?? "–"), words(last.structure ?? "–")],
    ...names.map((name) => [[name, unitOf(name, last.structure, units)].filter(Boolean).join(", "), shown(first[name], NaN), shown(last[name], half(name))]),
    ...["Kp", "Ti", "Td"].map((name) => [`${name}, ${name === "Kp" ? inUnits("output/PV", units) : "s"} (${gains.after?.goal ?? "balanced"})`, number(controller(gains.before, name)), number(controller(gains.after, name))]),
    ...Object.entries(MARGINS).map(([name, title]) => [title, number(gains.before?.margins?.[name], 3), number(gains.after?.margins?.[name], 3)])];
  return table("Process and gains", ["", "Before", "After"], rows);
}

/** Measured PV against the model before and after, and both residuals. */
export function beforeAfterCard(curves, units) {
  const unit = (name, text) => (text ? `${name}, ${text}` : name);
  const chart = new Chart([
    { title: unit("PV", units.pv), weight: 2.2, series: [{ key: "pv", label: "measured", colour: "--c-pv", kind: "dots" }, { key: "before", label: "before", colour: "--c-model" }, { key: "after", label: "after", colour: "--c-residual" }] },
    { title: unit("output", units.output), weight: 0.9, series: [{ key: "output", label: "output", colour: "--c-output", kind: "step" }] },
    { title: unit("residual", units.pv), weight: 1.2, series: [{ key: "residual_before", label: "residual before", colour: "--c-model" }, { key: "residual_after", label: "residual after", colour: "--c-residual" }] }],
  { label: "Measured PV, the model before and after the effects, the output, and both residuals", height: 470 });
  chart.data = { ...curves, t: curves.t_s };
  chart.phases = [{ name: "check", label: "not fitted", from: curves.held_out_from_s, to: curves.t_s.at(-1) }];
  chart.draw();
  return h("section", { class: "card", "aria-label": "Before and after" }, h("h2", {}, "Measured against the model, before and after"), chart.element,
    h("p", { class: "small muted" }, "The shaded part was not fitted: there the explanation has to prove itself."));
}
