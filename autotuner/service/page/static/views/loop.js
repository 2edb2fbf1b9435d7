// One loop: state, trend and the button that starts a test on the first screen; settings, gains and history below.

import { get } from "../api.js";
import { facts, fill, h, number, problemBox } from "../dom.js";
import { history } from "./history.js";
import { monitoring } from "./monitoring.js";
import { startForm } from "./start.js";
import { stateBadge, stateOf, trouble, valuesOf } from "./state.js";
import { Trend } from "./trend.js";

const POLL_MS = 1000;
/** Why a test cannot be started in a state; in the others it can. */
const BLOCKED = { waiting: "Waiting for the first reading.", dead: "Start is off: the device does not answer.", lost: "Start is off: the service does not answer." };

export async function loopView(root, signal, name) {
  const loop = await get(`/v1/loops/${encodeURIComponent(name)}`, signal);
  if (loop.tuning_id) {
    location.replace(`#/tunings/${loop.tuning_id}`);
    return;
  }
  const trend = new Trend(loop, { idle: true });
  const form = startForm(loop, signal);
  const monitor = h("div", {});
  const parts = { monitor, badge: h("span", {}, stateBadge("waiting")), values: h("div", { class: "values four" }, valuesOf(loop)), note: h("div", {}) };
  const held = h("div", {}), past = h("div", { class: "card" });
  root.append(
    h("div", { class: "head" }, h("div", { class: "title" }, h("p", { class: "crumbs" }, h("a", { href: "#/" }, "Loops"), " /"), h("h1", {}, loop.name, " ", parts.badge)), parts.values, h("div", { class: "act" }, form.start, form.why)),
    parts.note,
    h("section", { class: "card", "aria-label": "Trend" }, trend.element),
    h("div", { class: "split" }, form.element, h("div", {}, held, monitor, configured(loop))),
    past, h("p", {}, h("a", { href: `#/audit/${encodeURIComponent(name)}` }, "Audit log of this loop")));
  history(past, `/v1/tunings?loop=${encodeURIComponent(name)}`, signal).catch((error) => signal.aborted || fill(past, problemBox(error)));
  monitoring(monitor, loop, signal).catch((error) => signal.aborted || fill(monitor, problemBox(error)));
  if (loop.gains) deviceGains(loop, held, signal);
  await readings(loop, trend, parts, form, signal);
}

/** The gains that the device holds now, by its own names. */
async function deviceGains(loop, place, signal) {
  const told = await get(loop.links.gains, signal).catch((error) => (signal.aborted ? null : { error }));
  if (!told) return;
  const shown = told.error ? h("p", { class: "small muted" }, told.error.message) : facts(Object.entries(told.values).map(([name, value]) => [name, number(value, 6)]));
  fill(place, h("section", { class: "card", "aria-label": "Gains in the device" }, h("h2", {}, "Gains in the device"), shown));
}

/** "process direct, controller reverse acting": a heater raises its PV, so its controller lowers the output. */
export const actions = (process) => `process ${process}, controller ${OPPOSITE[process]} acting`;
const OPPOSITE = { direct: "reverse", reverse: "direct" };

/** The same, from gains as a device holds them; `action` is the field of earlier versions. */
export const acting = (held) => actions(OPPOSITE[held.controller_action ?? held.action]);

function configured(loop) {
  const [low, high] = loop.limits.output;
  return h("section", { class: "card" }, h("h2", {}, "Configuration"), facts([
    ["Driver", loop.driver], ["Sample time", `${number(loop.sample_time_s)} s`], ["Actions", actions(loop.process_action)],
    ["Output limits", `${number(low)} to ${number(high)} ${loop.output_unit}`],
    ["PV limits", loop.limits.pv ? `${number(loop.limits.pv[0])} to ${number(loop.limits.pv[1])} ${loop.pv_unit}` : "none"],
    ["Output slew", loop.limits.output_slew_per_s ? `${number(loop.limits.output_slew_per_s)} ${loop.output_unit}/s` : "not limited"],
    ["Safe output", loop.limits.safe_output === null ? "the output before the test" : number(loop.limits.safe_output)],
    ["Gains in the device", loop.gains ? `${loop.gains.form} form, set-point weight b ${number(loop.gains.set_point_weight)}` : "not configured"]]));
}

async function readings(loop, trend, parts, form, signal) {
  let fresh = false; // the first answer is of the read before, which may be long ago
  while (!signal.aborted) {
    if (!document.hidden) {
      const told = await get(`/v1/readings?loop=${encodeURIComponent(loop.name)}`, signal).catch(() => null);
      if (signal.aborted) return;
      const reading = fresh || !told ? told && told.readings[0] : undefined;
      if (reading?.tuning_id) location.replace(`#/tunings/${reading.tuning_id}`);
      show(loop, reading, trend, parts, form);
      fresh = true;
    }
    await new Promise((done) => setTimeout(done, POLL_MS));
  }
}

function show(loop, reading, trend, parts, form) {
  const state = stateOf(reading);
  fill(parts.badge, stateBadge(state));
  fill(parts.values, valuesOf(loop, reading ?? undefined));
  trouble(parts.note, loop, state, reading);
  form.block(BLOCKED[state] ?? "");
  parts.monitor.dataset.link = state;
  if (state === "ready") {
    trend.add({ ...reading, t: Date.parse(reading.at) / 1000 });
    form.present(reading.output);
  } else if (state !== "waiting") {
    trend.empty({ dead: "No link to the device: no readings", lost: "The service does not answer", unknown: "Not read between tunings" }[state] ?? "No data");
  }
}
