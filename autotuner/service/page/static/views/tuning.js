// One tuning: live while it runs; when it has ended its verdict and gains first, and the details below in a fixed order.

import { follow, get, open } from "../api.js";
import { facts, fill, h, moment, number, problemBox } from "../dom.js";
import { gainsInDevice } from "./device.js";
import { beforeAfterCard, diagnosisCard, diagnosisLine, otherGains } from "./diagnosis.js";
import { liveView } from "./live.js";
import { fitCard, gainsCard, modelCard, remarks, verdictBox } from "./result.js";

export async function tuningView(root, signal, id) {
  const tuning = await get(`/v1/tunings/${encodeURIComponent(id)}`, signal);
  const loop = await get(tuning.links.loop, signal).catch(() => null);
  const place = h("div", {}), act = h("div", { class: "act" });
  root.append(
    h("div", { class: "head" }, h("div", { class: "title" },
      h("p", { class: "crumbs" }, h("a", { href: "#/" }, "Loops"), " / ", h("a", { href: `#/loops/${encodeURIComponent(tuning.loop)}` }, tuning.loop), ` / ${moment(tuning.started_at)}`),
      h("h1", {}, `Tuning of ${tuning.loop}`)), act), place);
  if (tuning.state === "running" && loop) await live(place, act, tuning, loop, signal);
  if (signal.aborted) return;
  fill(act);
  await ended(place, id, loop, signal);
}

async function live(place, act, tuning, loop, signal) {
  const view = liveView(tuning, loop);
  fill(place, view.element);
  fill(act, view.abort);
  await follow(tuning.links.events, (events) => { for (const event of events) view.take(event); view.refresh(); }, view.connected, signal);
  dispatchEvent(new Event("tunings-changed"));
}

/** A place of fixed height that a card fills when it is computed, so that nothing below it moves. */
const slot = (name, text) => h("div", { class: `slot ${name}` }, h("section", { class: "card" }, h("p", { class: "muted", role: "status" }, text)));

async function ended(place, id, loop, signal) {
  const tuning = await get(`/v1/tunings/${encodeURIComponent(id)}`, signal);
  const units = { pv: loop?.pv_unit ?? "", output: loop?.output_unit ?? "" };
  const gains = tuning.model && slot("gains", "The gains of every goal are being compared …");
  const picture = tuning.samples > 1 && slot("picture", "The picture of the record is being made …");
  const explained = tuning.diagnosis?.effects?.length > 0 && slot("picture", "The picture before and after is being made …");
  const device = tuning.tuning ? gainsInDevice(tuning, loop, units, signal) : null;
  fill(place,
    tuning.verdict ? verdictBox(tuning.verdict) : h("p", { class: "notice" }, "It still runs."),
    tuning.restored === false ? h("p", { class: "notice bad", role: "alert" }, "The output could not be confirmed at its value before. Check the device.") : null,
    device?.element, device?.verification,
    otherGains(tuning), diagnosisLine(tuning.diagnosis), remarks((tuning.warnings ?? []).filter((text) => !text.startsWith("diagnosis:") && !(tuning.tuning?.warnings ?? []).includes(text))),
    ...(tuning.notes ?? []).filter((text) => !(tuning.tuning?.warnings ?? []).includes(text)).map((text) => h("p", { class: "notice" }, `Note: ${text}`)),
    tuning.tuning?.advice ? h("p", { class: "notice" }, `Controller advised: ${tuning.tuning.advice.text}.`) : null,
    files(tuning, loop), gains, modelCard(tuning, units), picture, diagnosisCard(tuning.diagnosis, units), explained, howItRan(tuning, units));
  const put = (where, path, card) => get(`/v1/tunings/${encodeURIComponent(id)}/${path}`, signal).then((told) => fill(where, card(told)), (error) => signal.aborted || fill(where, problemBox(error)));
  await Promise.all([
    gains && put(gains, "choices", ({ choices }) => { if (choices.length) device?.offer(choices); return gainsCard(choices, units); }),
    picture && put(picture, "curves", (curves) => fitCard(curves, units, tuning.recommended === "diagnosis" ? tuning.diagnosis.effects.map(({ name }) => name) : [])),
    explained && put(explained, "before-after", (curves) => beforeAfterCard(curves, units))]);
}

function files(tuning, loop) {
  return h("div", { class: "row files" },
    tuning.links.report ? h("button", { onclick: () => open(tuning.links.report) }, "Report") : null,
    h("button", { onclick: () => open(tuning.links.recording, `${tuning.id}.csv`) }, "Recording (CSV)"),
    h("button", { onclick: () => open(tuning.links.self, `${tuning.id}.json`) }, "Result (JSON)"),
    tuning.links.export ? h("button", { onclick: () => open(tuning.links.export, `${tuning.id}.tuning`) }, "Export") : null,
    loop ? h("a", { class: "button", href: `#/loops/${encodeURIComponent(tuning.loop)}` }, "Tune again") : null);
}

function howItRan(tuning, units) {
  const { settings } = tuning;
  const unit = (value, text) => `${number(value)}${text && ` ${text}`}`;
  return h("section", { class: "card", "aria-label": "Test" }, h("h2", {}, "Test"), facts([
    ["Number", tuning.id], ["Started by", tuning.actor], ["Samples", String(tuning.samples)], ["Output before", tuning.before ? unit(tuning.before.output, units.output) : "–"],
    ["Output restored", tuning.restored === true ? "yes" : tuning.restored === false ? "not confirmed" : "not known"],
    ["Lateness, 99 %", tuning.lateness ? `${number(1000 * tuning.lateness.p99_s, 2)} ms` : "–"],
    ["Amplitude", settings.amplitude === null ? "suggested" : unit(settings.amplitude, units.output)], ["Check", settings.check ? "yes" : "left out"],
    ["Output limits", settings.limits?.output ? `${settings.limits.output.map((value) => number(value)).join(" to ")} ${units.output}` : "–"]]));
}
