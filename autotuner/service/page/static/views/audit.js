// Who did what: the audit, of all or of one loop, the newest first. It is only read here; nobody can change it.

import { get } from "../api.js";
import { fill, h, headCell, moment } from "../dom.js";

const AT_ONCE = 50;
/** What an action did, in words: the first row whose pattern matches. Others are told as they are. */
const WORDS = [
  [/^POST \/v1\/loops\/.+\/tunings$/, "started a tuning"],
  [/^POST \/v1\/loops\/.+\/schedules$/, "started tunings at several set points"],
  [/^POST \/v1\/tunings\/[^/]+\/abort$/, "aborted the tuning"],
  [/^POST \/v1\/tunings\/[^/]+\/apply$/, "wrote gains into the device"],
  [/^POST \/v1\/tunings\/[^/]+\/verify$/, "verified the gains in the device"],
  [/^POST \/v1\/tunings\/[^/]+\/rollback$/, "restored the gains before"],
  [/^POST \/v1\/schedules\/[^/]+\/abort$/, "aborted the tunings at several set points"],
  [/^POST \/v1\/schedules$/, "combined tunings"],
  [/^POST \/v1\/reload$/, "reloaded the configuration"],
  [/^autotuner apply /, "wrote gains into the device"],
  [/^autotuner rollback /, "restored the gains before"],
  [/^autotuner tune .* --(apply|verify)$/, "started a tuning that writes its gains"],
  [/^autotuner tune /, "started a tuning"],
];

export async function auditView(root, signal, loop = "") {
  const { loops } = await get("/v1/loops", signal);
  const names = [...new Set([...loops.map((one) => one.name), loop].filter(Boolean))];
  const choice = h("select", { onchange: () => { location.hash = choice.value ? `#/audit/${encodeURIComponent(choice.value)}` : "#/audit"; } },
    h("option", { value: "" }, "all loops, and the service"), names.map((name) => h("option", { value: name }, name)));
  choice.value = loop;
  const place = h("div", {});
  root.append(h("h1", {}, "Audit log"),
    h("div", { class: "card" }, h("div", { class: "row" }, h("label", {}, "Loop", choice)),
      h("p", { class: "small muted" }, "Everything that moved an output, wrote gains or changed the service, over the page, REST or the shell. Requests that were refused did nothing and are not listed."), place));
  await entries(place, loop, signal);
}

async function entries(place, loop, signal) {
  const body = h("tbody", {});
  const older = h("button", { hidden: true, onclick: () => more() }, "Older");
  let last = null;
  const more = async () => {
    older.disabled = true;
    const query = new URLSearchParams({ limit: AT_ONCE, ...(loop && { loop }), ...(last && { before: last }) });
    const { entries: found } = await get(`/v1/audit?${query}`, signal);
    body.append(...found.map(row));
    last = found.at(-1)?.number;
    older.disabled = false;
    older.hidden = found.length < AT_ONCE;
    return found.length;
  };
  if (!(await more())) {
    fill(place, h("p", { class: "muted" }, "Nothing yet."));
    return;
  }
  fill(place, h("div", { class: "scroll", tabindex: "0", role: "region", "aria-label": "Audit" }, h("table", { class: "wrapped" },
    h("thead", {}, h("tr", {}, ["Time", "Who", "Action", "Loop", "Tuning", "Result"].map(headCell))), body)), older);
}

function row(entry) {
  const words = WORDS.find(([pattern]) => pattern.test(entry.action))?.[1];
  return h("tr", {},
    h("th", { scope: "row" }, moment(entry.at)), h("td", {}, entry.actor),
    h("td", { title: entry.action }, words ?? entry.action),
    h("td", {}, entry.loop ? h("a", { href: `#/loops/${encodeURIComponent(entry.loop)}` }, entry.loop) : "–"),
    h("td", {}, entry.tuning_id ? h("a", { href: `#/tunings/${encodeURIComponent(entry.tuning_id)}` }, entry.tuning_id) : "–"),
    h("td", {}, h("span", { class: `badge ${entry.status < 400 ? "done" : "failed"}` }, entry.status < 400 ? "done" : `failed (${entry.status})`)));
}
