// One tuning: live while it runs, its result when it has ended.

import { follow, get, open } from "../api.js";
import { facts, fill, h, moment, number, problemBox } from "../dom.js";
import { deviceActions } from "./device.js";
import { beforeAfterCard, diagnosisCard, diagnosisLine, otherGains } from "./diagnosis.js";
import { liveView } from "./live.js";
import { fitCard, gainsCard, modelCard, remarks, verdictBox } from "./result.js";

export async function tuningView(root, signal, id) {
  const tuning = await get(`/v1/tunings/${encodeURIComponent(id)}`, signal);
  const loop = await get(tuning.links.loop, signal).catch(() => null);
  const place = h("div", {});
  root.append(
    h("p", { class: "crumbs" }, h("a", { href: "#/" }, "Loops"), " / ", h("a", { href: `#/loops/${encodeURIComponent(tuning.loop)}` }, tuning.loop), " /"),
    h("h1", {}, `Tuning of ${tuning.loop}`), h("p", { class: "muted small" }, `Started ${moment(tuning.started_at)}, number ${tuning.id}`), place);
  if (tuning.state === "running" && loop) await live(place, tuning, loop, signal);
  if (!signal.aborted) await ended(place, id, loop, signal);
}

async function live(place, tuning, loop, signal) {
  const view = liveView(tuning, loop);
  fill(place, view.element);
  await follow(tuning.links.events, (events) => { for (const event of events) view.take(event); view.refresh(); }, view.connected, signal);
  dispatchEvent(new Event("tunings-changed"));
}

async function ended(place, id, loop, signal) {
  const tuning = await get(`/v1/tunings/${encodeURIComponent(id)}`, signal);
  const units = { pv: loop?.pv_unit ?? "", output: loop?.output_unit ?? "" };
  const pictures = h("div", {}), explained = h("div", {}), gains = h("div", {});
  fill(place,
    tuning.verdict ? verdictBox(tuning.verdict) : h("p", { class: "notice" }, "It still runs."),
    tuning.restored === false ? h("p", { class: "notice bad", role: "alert" }, "The output could not be confirmed at its value before. Check the device.") : null,
    diagnosisLine(tuning.diagnosis), remarks((tuning.warnings ?? []).filter((text) => !text.startsWith("diagnosis:"))),
    files(tuning, loop), h("p", {}), gains, modelCard(tuning, units), pictures, diagnosisCard(tuning.diagnosis, units), explained, howItRan(tuning, units));
  const put = (where, path, card) => get(`/v1/tunings/${encodeURIComponent(id)}/${path}`, signal).then((told) => fill(where, card(told)), (error) => signal.aborted || fill(where, problemBox(error)));
  const chosen = tuning.tuning?.goal ?? tuning.tuning?.rule;
  if (tuning.model) fill(gains, h("p", { class: "notice", role: "status" }, "The gains are being compared …"));
  await Promise.all([
    tuning.model && put(gains, "choices", ({ choices }) => gainsCard(choices, chosen, units, [otherGains(tuning), deviceActions(tuning, choices, loop)])),
    tuning.samples > 1 && put(pictures, "curves", (curves) => fitCard(curves, units)),
    tuning.diagnosis?.effects?.length && put(explained, "before-after", (curves) => beforeAfterCard(curves, units))]);
}

function files(tuning, loop) {
  return h("div", { class: "row" },
    tuning.links.report ? h("button", { onclick: () => open(tuning.links.report) }, "Report") : null,
    h("button", { onclick: () => open(tuning.links.recording, `${tuning.id}.csv`) }, "Recording (CSV)"),
    h("button", { onclick: () => open(tuning.links.self, `${tuning.id}.json`) }, "Result (JSON)"),
    tuning.links.export ? h("button", { onclick: () => open(tuning.links.export, `${tuning.id}.tuning`) }, "Everything (one file)") : null,
    loop ? h("a", { class: "button", href: `#/loops/${encodeURIComponent(tuning.loop)}` }, "Tune again") : null);
}

function howItRan(tuning, units) {
  const { settings } = tuning;
  const unit = (value, text) => `${number(value)}${text && ` ${text}`}`;
  return h("section", { class: "card", "aria-label": "How it ran" }, h("h2", {}, "How it ran"), facts([
    ["Samples", String(tuning.samples)], ["Output before", tuning.before ? unit(tuning.before.output, units.output) : "–"],
    ["Given back", tuning.restored === true ? "yes" : tuning.restored === false ? "not confirmed" : "not known"],
    ["Lateness, 99 %", tuning.lateness ? `${number(1000 * tuning.lateness.p99_s, 2)} ms` : "–"],
    ["Amplitude", settings.amplitude === null ? "suggested" : unit(settings.amplitude, units.output)], ["Check", settings.check ? "yes" : "left out"],
    ["Output limits", settings.limits?.output ? `${settings.limits.output.map((value) => number(value)).join(" to ")} ${units.output}` : "–"]]));
}
