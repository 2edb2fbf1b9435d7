// What a loop shows now: its state as a word with a colour, its values, and what to do about a dead link.

import { fill, h, number } from "../dom.js";

const STATES = {
  ready: ["done", "ready"], waiting: ["", "connecting"], tuning: ["running", "tuning"], unknown: ["", "not read between tunings"],
  dead: ["failed", "no link"], lost: ["failed", "service lost"],
};
const MODES = { 0: "manual", 1: "automatic" };

/** The state of a loop by its latest reading; undefined: none yet, null: the service does not answer. */
export function stateOf(reading) {
  if (reading === null) return "lost";
  if (!reading) return "waiting";
  if (reading.tuning_id) return "tuning";
  if (reading.link === "down") return "dead";
  if (reading.link === "up") return "ready";
  return reading.error ? "unknown" : "waiting";
}

export function stateBadge(state) {
  const [look, words] = STATES[state];
  return h("span", { class: `badge ${look}`, "data-state": state }, words);
}

/** PV, set point, output and mode of a reading as large numbers. */
export function valuesOf(loop, reading) {
  const value = (name, look, number_, unit) => h("div", { class: `value ${look}` }, h("span", {}, name), h("b", {}, number_, unit ? h("small", {}, unit) : null));
  const stale = reading && reading.link !== "down";
  const shown = (what) => (stale ? number(reading[what], 5) : "–");
  return [
    value("PV", "pv", shown("pv"), loop.pv_unit), value("Set point", "sp", shown("set_point"), loop.pv_unit),
    value("Output", "output", shown("output"), loop.output_unit), value("Mode", "", (stale && MODES[reading.auto]) || "–", "")];
}

/** Why nothing can be started, with cause and remedy; nothing where all is well. Filled in place, so that it stays put. */
export function trouble(place, loop, state, reading) {
  if (place.dataset.shown === state + (reading?.error ?? "")) return;
  place.dataset.shown = state + (reading?.error ?? "");
  if (state === "dead") {
    fill(place, h("div", { class: "notice bad", role: "alert", "data-trouble": "dead" }, h("strong", {}, `No link to the device of ${loop.name}`),
      h("p", {}, reading.error), h("p", {}, "The page tries again by itself; Start is off until the device answers.")));
  } else if (state === "lost") {
    fill(place, h("div", { class: "notice bad", role: "alert", "data-trouble": "lost" }, h("strong", {}, "The service does not answer"),
      h("p", {}, "Nothing is known of the loop now. Check that `autotuner serve` runs and that this computer reaches it; the page goes on by itself.")));
  } else if (state === "unknown") {
    fill(place, h("p", { class: "notice" }, reading.error));
  } else {
    fill(place);
  }
}
