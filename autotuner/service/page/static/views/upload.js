// A recording from elsewhere: columns and units are chosen on screen, shown, then identified or diagnosed. Nothing is moved.

import { upload } from "../api.js";
import { Chart } from "../chart.js";
import { fill, h, problemBox } from "../dom.js";
import { numberOf, secondsOf, tableOf } from "../table.js";
import { beforeAfterCard, diagnosisCard } from "./diagnosis.js";
import { fitCard, gainsCard, modelCard, remarks, verdictBox } from "./result.js";

const POINTS = 4000;
const NONE = -1;
/** What a column may be, with the names by which it is guessed. */
const ROLES = [
  { role: "t", label: "Time", names: /^(t|time|zeit|date.*|timestamp)\b/i },
  { role: "u", label: "Output", names: /^(u|output|out|op|co|mv|valve|heater)\b/i },
  { role: "y", label: "PV", names: /^(y|pv|process.*|temp.*|measured.*)\b/i },
  { role: "sp", label: "Set point", names: /^(sp|set.?point|r)\b/i, optional: true },
];
const TIME_UNITS = [["1", "seconds"], ["0.001", "milliseconds"], ["60", "minutes"], ["3600", "hours"], ["date", "date and time"]];
const ACTS = [["identifications", "Identify", "Which process is it?"], ["diagnoses", "Diagnose", "What does a model of it lack?"]];
const SHOWN = {
  identifications: (told, units) => [
    told.verdict ? verdictBox(told.verdict) : null,
    remarks([...(told.warnings ?? []), ...(told.notes ?? [])]),
    modelCard(told, units), told.curves ? fitCard(told.curves, units) : null, told.choices?.length ? gainsCard(told.choices, units) : null],
  diagnoses: (told, units) => [diagnosisCard(told, units), told.curves ? beforeAfterCard(told.curves, units) : null],
};

export async function uploadView(root, signal) {
  const result = h("div", { "aria-live": "polite" }), mapping = h("div", {});
  const file = h("input", { type: "file", accept: ".csv,.txt,.tsv,text/csv,text/plain", id: "file" });
  const drop = h("div", { class: "drop" }, h("label", { for: "file" }, "Drop a CSV file here, or choose one"), file,
    h("p", { class: "small muted" }, "One row a sample. Columns and units are chosen next; nothing leaves this service, and no output is moved."));
  root.append(h("h1", {}, "Upload a recording"), h("div", { class: "card" }, drop), mapping, result);
  const take = async (chosen) => {
    if (!chosen) return;
    fill(result);
    try {
      fill(mapping, mappingCard(chosen.name, tableOf(await chosen.text()), result, signal));
    } catch (error) {
      fill(mapping, problemBox({ title: `${chosen.name} cannot be read`, detail: error.message }));
    }
  };
  file.addEventListener("change", () => take(file.files[0]));
  for (const [name, over] of [["dragover", true], ["dragleave", false]]) {
    drop.addEventListener(name, (event) => { event.preventDefault(); drop.classList.toggle("over", over); });
  }
  drop.addEventListener("drop", (event) => { event.preventDefault(); drop.classList.remove("over"); take(event.dataTransfer.files[0]); });
}

/** The card in which columns and units are chosen, with a preview, and the buttons that work on the file. */
function mappingCard(name, table, result, signal) {
  const guesses = guessed(table);
  const column = ({ role, label, optional }) => h("label", {}, `${label} is`, choice(role, guesses[role], [...(optional ? [[NONE, "not in the file"]] : []), ...table.head.map((text, index) => [index, text])]));
  const text = (field, label) => h("label", {}, label, h("input", { name: field, placeholder: "none", autocomplete: "off" }));
  const form = h("form", { novalidate: true, onsubmit: (event) => event.preventDefault() },
    h("div", { class: "fields" }, ROLES.map(column), h("label", {}, "Unit of the time", choice("unit", timeUnit(table, guesses.t), TIME_UNITS)), text("pv_unit", "Unit of the PV"), text("output_unit", "Unit of the output")));
  const preview = h("div", {}), told = h("p", { class: "small muted", role: "status" });
  const state = { mapped: null, units: { pv: "", output: "" } };
  const buttons = ACTS.map(([kind, label, title]) => h("button", { type: "button", title, class: kind === "identifications" ? "main" : null, onclick: () => work(kind, name, state, result, signal) }, label));
  const refresh = () => {
    const chosen = Object.fromEntries(["t", "u", "y", "sp", "unit", "pv_unit", "output_unit"].map((field) => [field, form.elements[field].value]));
    state.units = { pv: chosen.pv_unit, output: chosen.output_unit };
    state.mapped = mapped(table, chosen);
    told.textContent = state.mapped.problem || `${state.mapped.t.length} samples over ${Math.round(state.mapped.t.at(-1) - state.mapped.t[0])} s.`;
    for (const button of buttons) button.disabled = Boolean(state.mapped.problem);
    fill(preview, state.mapped.problem ? null : picture(state.mapped, state.units));
  };
  form.addEventListener("input", refresh);
  refresh();
  return h("section", { class: "card", "aria-label": "Columns and units" }, h("h2", {}, name), form, told, preview, h("div", { class: "row end" }, buttons));
}

function choice(name, value, options) {
  const select = h("select", { name }, options.map(([key, text]) => h("option", { value: key }, text)));
  select.value = value;
  return select;
}

/** The columns by their names; the first that are left where no name fits. */
function guessed({ head }) {
  const found = Object.fromEntries(ROLES.map(({ role, names }) => [role, head.findIndex((text) => names.test(text))]));
  for (const { role, optional } of ROLES) {
    if (found[role] < 0 && !optional) found[role] = Math.max(0, head.findIndex((_, index) => !Object.values(found).includes(index)));
  }
  return found;
}

function timeUnit({ head, rows }, column) {
  const name = head[column] ?? "";
  if (Number.isNaN(numberOf(rows[0][column])) && !Number.isNaN(Date.parse(rows[0][column]))) return "date";
  return /\bms\b|milli/i.test(name) ? "0.001" : /\bmin/i.test(name) ? "60" : /\bh(ours?)?\b/i.test(name) ? "3600" : "1";
}

/** The samples of the chosen columns, times in s; `problem` says in words what cannot be. */
function mapped({ rows }, chosen) {
  const columns = [chosen.t, chosen.u, chosen.y].map(Number);
  if (new Set(columns).size < 3) return { problem: "Time, output and PV are three different columns." };
  const t = secondsOf(rows, columns[0], chosen.unit === "date" ? null : Number(chosen.unit));
  const all = rows.map((row, i) => [t[i] - t[0], numberOf(row[columns[1]]), numberOf(row[columns[2]]), Number(chosen.sp) === NONE ? NaN : numberOf(row[Number(chosen.sp)])]);
  const kept = all.filter((sample) => Number.isFinite(sample[0]) && Number.isFinite(sample[1]) && Number.isFinite(sample[2]));
  if (kept.length < 3) return { problem: "These columns hold no numbers: choose others, or another unit of the time." };
  if (kept.some((sample, i) => i && sample[0] < kept[i - 1][0])) return { problem: "The time does not grow from row to row: choose another column for it." };
  const column = (index) => kept.map((sample) => sample[index]);
  return { t: column(0), u: column(1), y: column(2), sp: Number(chosen.sp) === NONE ? null : column(3) };
}

function picture({ t, u, y, sp }, units) {
  const unit = (name, text) => (text ? `${name}, ${text}` : name);
  const chart = new Chart([
    { title: unit("PV", units.pv), weight: 2, series: [{ key: "sp", label: "SP", colour: "--c-sp", kind: "step", near: true }, { key: "y", label: "PV", colour: "--c-pv" }] },
    { title: unit("output", units.output), series: [{ key: "u", label: "output", colour: "--c-output", kind: "step" }] }], { label: "Preview of the recording: PV above, output below", height: 300 });
  chart.data = { t, u, y, ...(sp && { sp }) };
  chart.draw();
  return chart.element;
}

/** The chosen samples as the service reads them. */
function csvOf({ t, u, y, sp }) {
  const cell = (value) => (Number.isFinite(value) ? String(value) : "");
  return new Blob([[sp ? "t,u,y,sp" : "t,u,y", ...t.map((time, i) => [time, u[i], y[i], ...(sp ? [sp[i]] : [])].map(cell).join(","))].join("\n")], { type: "text/csv" });
}

async function work(kind, name, { mapped: samples, units }, result, signal) {
  fill(result, h("p", { class: "notice", role: "status" }, `${name} is being computed …`));
  result.scrollIntoView({ block: "nearest" });
  try {
    const told = await upload(`/v1/${kind}?points=${POINTS}`, csvOf(samples), signal);
    fill(result, h("h2", {}, kind === "diagnoses" ? `Diagnosis of ${name}` : `Identification of ${name}`), SHOWN[kind](told, units));
  } catch (error) {
    if (!signal.aborted) fill(result, problemBox(error));
  }
}
