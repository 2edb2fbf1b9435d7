// The history: every tuning, and two of them side by side.

import { get } from "../api.js";
import { fill, h, headCell, moment } from "../dom.js";

const POLL_MS = 2000;

export async function tuningsView(root, signal) {
  root.append(h("h1", {}, "Tunings"));
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

async function show(place, path, signal) {
  const { tunings } = await get(path, signal);
  if (!tunings.length) {
    fill(place, h("h2", {}, "History"), h("p", { class: "muted" }, "No tuning yet."));
    return tunings;
  }
  const chosen = new Set();
  const compare = h("button", { disabled: true, onclick: () => { location.hash = `#/compare/${[...chosen].join("/")}`; } }, "Compare the two");
  const rows = tunings.map((tuning) => h("tr", {},
    h("th", { scope: "row" }, h("a", { href: `#/tunings/${tuning.id}` }, moment(tuning.started_at))),
    h("td", {}, h("a", { href: `#/loops/${encodeURIComponent(tuning.loop)}` }, tuning.loop)),
    h("td", {}, h("span", { class: `badge ${tuning.outcome ?? "running"}` }, tuning.outcome ?? tuning.phase)),
    h("td", { class: "muted" }, tuning.code ?? ""),
    h("td", {}, h("label", { class: "check" }, h("input", { type: "checkbox", onchange: (event) => pick(event.target, tuning.id) }), h("span", { class: "visually-hidden" }, `Compare the tuning of ${moment(tuning.started_at)}`)))));
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
  fill(place, h("div", { class: "row" }, h("h2", {}, "History"), compare),
    h("div", { class: "scroll", tabindex: "0", role: "region", "aria-label": "History of tunings" }, h("table", {},
      h("thead", {}, h("tr", {}, ["Started", "Loop", "Ended", "Because", "Compare"].map(headCell))),
      h("tbody", {}, rows))));
  return tunings;
}
