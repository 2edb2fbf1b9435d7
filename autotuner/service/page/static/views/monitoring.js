// A loop in its normal running: whether it is monitored, and what that has shown. Nothing is written to the device.

import { get, post, remove } from "../api.js";
import { duration, facts, fill, h, moment, number, problemBox, table } from "../dom.js";

const POLL_MS = 5000;
const WORDS = {
  as_expected: ["done", "as expected"], at_rest: ["", "at rest"], disturbed: ["running", "disturbed"],
  retune_advised: ["failed", "retune advised"], valve_sticking: ["failed", "valve sticking"],
};

/** What the last window of a monitored loop says, as a badge; nothing of one that is not monitored. */
export function watchBadge(code) {
  if (!code) return null;
  const [look, words] = WORDS[code] ?? ["", code.replaceAll("_", " ")];
  return h("span", { class: `badge ${look}` }, words);
}

/** Show the monitoring of a loop until the view is left. */
export async function monitoring(place, loop, signal) {
  const path = `/v1/loops/${encodeURIComponent(loop.name)}/monitor`;
  const last = await lastTuned(loop, signal);
  const told = h("div", { "aria-live": "polite" }), trouble = h("div", {});
  const button = h("button", { type: "button", "data-monitor": "", onclick: () => turn() });
  let state = null;
  const show = (monitor) => {
    state = monitor.state;
    button.textContent = state === "off" ? "Start monitoring" : "Stop monitoring";
    button.disabled = state === "off" && (!last || place.dataset.link === "dead");
    fill(told, state === "off" ? asleep(last) : awake(monitor));
  };
  const turn = async () => {
    button.disabled = true;
    fill(trouble);
    try {
      show(state === "off" ? await post(path, { tuning_id: last.id }) : await remove(path));
    } catch (error) {
      button.disabled = false;
      fill(trouble, problemBox(error));
    }
  };
  const look = async () => show(await get(path, signal));
  await look();
  fill(place, h("section", { class: "card", "aria-label": "Monitoring" }, h("div", { class: "row" }, h("h2", {}, "Monitoring"), button), trouble, told));
  while (!signal.aborted) {
    await new Promise((done) => setTimeout(done, POLL_MS));
    if (!document.hidden && !signal.aborted && !button.disabled) await look().catch(() => {}); // the top of the page tells a lost link
  }
}

/** The newest tuning of a loop whose model states what to expect; undefined where there is none. */
async function lastTuned(loop, signal) {
  const { tunings } = await get(`/v1/tunings?loop=${encodeURIComponent(loop.name)}`, signal);
  return tunings.find((tuning) => tuning.outcome === "done");
}

function asleep(last) {
  const from = last ? [" of ", h("a", { href: `#/tunings/${last.id}` }, moment(last.started_at)), "."] : null;
  return h("p", { class: "small muted" }, "Compares the loop in normal running with its tuning: process, oscillation, valve friction. It reads only. ",
    last ? ["Reference: the tuning", from] : "It needs a tuning that ended well.");
}

function awake(monitor) {
  const { findings } = monitor;
  const share = Math.min(monitor.seen_s / monitor.window_s, 1);
  return [
    monitor.trouble ? h("p", { class: "notice warn" }, monitor.trouble) : null,
    findings ? found(findings) : h("p", { class: "small muted" }, "Nothing is judged yet."),
    h("div", { class: "accuracy" }, h("p", { class: "small" }, `${duration(monitor.seen_s)} of a window of ${duration(monitor.window_s)} seen, a sample every ${duration(monitor.every_s)}`),
      h("progress", { class: "bar", max: 1, value: share, "aria-label": "Share of the window that is seen" })),
    h("p", { class: "small muted" }, "By the tuning ", h("a", { href: `#/tunings/${monitor.tuning_id}` }, monitor.tuning_id), `, monitored since ${moment(monitor.started_at)}`, monitor.judged_at ? `, judged ${moment(monitor.judged_at)}` : "", "."),
  ];
}

function found(findings) {
  const swing = findings.oscillation;
  const sizes = Object.entries(findings.effects).map(([name, parameters]) => [name.replaceAll("_", " "), Object.entries(parameters).map(([key, value]) => `${key} ${number(value, 3)}`).join(", ")]);
  const changes = Object.entries(findings.process).map(([name, change]) => [name, number(change.expected), number(change.found), change.interval95.map((end) => number(end)).join(" to ")]);
  return [
    h("p", { "data-finding": findings.code }, watchBadge(findings.code), " ", findings.message),
    findings.remedy ? h("p", {}, findings.remedy) : null,
    facts([["Error, root mean square", number(findings.error, 3)], ["Noise, standard deviation", number(findings.noise, 3)],
      swing && ["Oscillation", `period ${duration(swing.period_s)}, amplitude ${number(swing.amplitude, 3)}`],
      findings.Ms && ["Ms, expected and found", findings.Ms.map((value) => (value === null ? "unstable" : number(value, 3))).join(", ")], ...sizes]),
    changes.length ? h("details", {}, h("summary", {}, "The process, then and now"), table("Parameters with the 95 % interval of what was found", ["", "Expected", "Found", "95 % interval"], changes)) : null,
    findings.notes.length ? h("p", { class: "small muted" }, findings.notes.join("; ")) : null,
  ];
}
