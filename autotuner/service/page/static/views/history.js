// The history: every tuning with what it found, and two of them side by side.

import { get } from "../api.js";
import { fill, h, headCell, moment, number } from "../dom.js";

const POLL_MS = 2000;

export async function historyView(root, signal) {
  root.append(h("h1", {}, "History"));
  const place = h("div", { class: "card" });
  root.append(place);
  await history(place, "/v1/tunings", signal);
}

/** Show the tunings of a list; two can be chosen and compared. */
export async function history(place, path, signal) {
  let tunings = await show(place, path, signal);
  while (tunings.some((tuning) => tuning.outcome === null)) {
    await new Promise((done) => setTimeout(done, POLL_MS));
    if (signal.aborted) return;
    tunings = await show(place, path, signal).catch(() => tunings);
  }
}

const COLUMNS = ["Started", "Loop", "Result", "K", "T, s", "D, s", "Kp", "Ti, s", "Td, s", "Goal", "Started by", "Gains", "Compare"];

/** The lags of a model, the longest first: T, T1 and T2, or what makes up `m s² + n s + 1`. */
function lags(model) {
  const found = ["T", "T1", "T2"].filter((name) => model?.[name] !== undefined).map((name) => number(model[name], 3));
  return found.join(", ") || (model?.m === undefined ? "–" : `m ${number(model.m, 3)}, n ${number(model.n, 3)}`);
}

function inDevice({ applied, verified }) {
  if (verified === true) return h("span", { class: "badge done" }, applied ? "verified" : "verified, not in the device");
  if (verified === false) return h("span", { class: "badge failed" }, "not verified, restored");
  return applied === true ? h("span", { class: "badge" }, "applied") : "not applied";
}

function row(tuning, pick) {
  const { model, gains } = tuning;
  return h("tr", {},
    h("th", { scope: "row" }, h("a", { href: `#/tunings/${tuning.id}` }, moment(tuning.started_at))),
    h("td", {}, h("a", { href: `#/loops/${encodeURIComponent(tuning.loop)}` }, tuning.loop)),
    h("td", {}, h("span", { class: `badge ${tuning.outcome ?? "running"}` }, tuning.outcome ?? tuning.phase), " ", h("span", { class: "small muted" }, tuning.code ?? "")),
    h("td", {}, number(model?.K, 3)), h("td", {}, lags(model)), h("td", {}, number(model?.D, 3)),
    h("td", {}, number(gains?.Kp, 3)), h("td", {}, number(gains?.Ti, 3)), h("td", {}, number(gains?.Td, 3)),
    h("td", {}, tuning.goal ?? "–"), h("td", {}, tuning.actor), h("td", {}, gains ? inDevice(tuning) : "–"),
    h("td", {}, h("label", { class: "check" }, h("input", { type: "checkbox", onchange: (event) => pick(event.target, tuning.id) }), h("span", { class: "visually-hidden" }, `Compare the tuning of ${moment(tuning.started_at)}`))));
}

async function show(place, path, signal) {
  const { tunings } = await get(path, signal);
  if (!tunings.length) {
    fill(place, h("h2", {}, "Tunings"), h("p", { class: "muted" }, "No tuning yet."));
    return tunings;
  }
  const chosen = new Set();
  const compare = h("button", { disabled: true, onclick: () => { location.hash = `#/compare/${[...chosen].join("/")}`; } }, "Compare two tunings");
  const pick = (box, id) => {
    if (box.checked) chosen.add(id);
    else chosen.delete(id);
    if (chosen.size > 2) {
      const oldest = chosen.values().next().value;
      chosen.delete(oldest);
      rows[tunings.findIndex((tuning) => tuning.id === oldest)].querySelector("input").checked = false;
    }
    compare.disabled = chosen.size !== 2;
  };
  const rows = tunings.map((tuning) => row(tuning, pick));
  fill(place, h("div", { class: "row" }, h("h2", {}, "Tunings"), compare),
    h("div", { class: "scroll", tabindex: "0", role: "region", "aria-label": "History of tunings" }, h("table", {},
      h("thead", {}, h("tr", {}, COLUMNS.map(headCell))), h("tbody", {}, rows))));
  return tunings;
}
