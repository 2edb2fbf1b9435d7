// A tuning while it runs: phases, time left, the trend, the running estimate with its interval, and the abort.

import { get, post } from "../api.js";
import { duration, facts, fill, h, number, plusMinus, problemBox } from "../dom.js";
import { METHODS, unitOf } from "./result.js";
import { Trend } from "./trend.js";

const PHASES = ["arm", "quiet", "approach", "relay", "check", "restore"];
const SOMETIMES = new Set(["approach"]);
export const ABORT = "Abort and restore";
const CHECK_PERIODS = 7;

/** What is shown of a running tuning: `element`, the button `abort`, `take` for an event, `refresh`, `connected`. */
export function liveView(tuning, loop) {
  const trend = new Trend(loop);
  const seen = { phase: "arm", since: 0, t: 0, relayFrom: null, estimate: null, model: null };
  const said = h("p", { class: "visually-hidden", "aria-live": "polite" });
  const times = h("div", {}), numbers = h("div", {}), link = h("div", {}), trouble = h("div", {});
  const phases = h("ol", { class: "phases", "aria-label": "Phases" }, PHASES.filter((name) => !SOMETIMES.has(name)).map(phaseItem));
  const accuracy = accuracyBar(tuning.settings.accuracy);
  const abort = h("button", { class: "abort", onclick: () => stop(tuning, abort, trouble) }, ABORT);
  const takers = {
    sample(event) { seen.t = event.t; trend.add(event); if (seen.phase === "relay") trend.swing(event.output, seen.relayFrom); },
    observed(event) { seen.t = event.t; trend.add(event); },
    phase(event) { enter(event, seen, phases, trend, said, abort); },
    estimate(event) { seen.estimate = { ...event, at: seen.t }; relaySeen(tuning, seen, trend); },
    model(event) { seen.model = event; accuracy.show(event.relative_error); },
    link(event) { fill(link, h("p", { class: "notice warn" }, event.message)); },
    output_unknown(event) { fill(link, h("p", { class: "notice bad", role: "alert" }, `The output is not known (attempt ${event.attempts}): ${event.message}`)); },
    bump(event) { fill(trouble, h("p", { class: "notice warn" }, `The output jumped by ${number(event.output)} ${loop.output_unit} when the loop was released (noise ${number(event.noise)}).`)); },
    restored(event) { fill(link, h("p", { class: "notice done" }, `The output is back at ${number(event.output)} ${loop.output_unit}${event.verified ? ", read back" : ", not read back"}. The result is being computed.`)); },
  };
  const element = h("div", {}, said,
    h("section", { class: "card progress", "aria-label": "Progress" }, h("div", { class: "row" }, phases, times), link, trouble),
    h("section", { class: "card", "aria-label": "Trend" }, trend.element),
    h("section", { class: "card", "aria-label": "Running estimate" }, h("h2", {}, "Running estimate"), numbers, accuracy.element));
  return {
    element, abort,
    take: (event) => takers[event.type]?.(event),
    refresh: () => { mark(phases, seen.phase); fill(times, facts(clock(seen, tuning.settings))); fill(numbers, facts(progress(seen, loop))); },
    connected: (stands) => (stands ? fill(trouble) : fill(trouble, h("p", { class: "notice bad", role: "alert" }, "The connection to the service was lost; the page connects again. The test goes on by itself."))),
  };
}

const phaseItem = (name) => h("li", { "data-phase": name }, name);

function enter(event, seen, phases, trend, said, abort) {
  if (event.phase === seen.phase && seen.entered) return;
  seen.entered = true;
  if (seen.phase === "relay") trend.bandsEnd(event.t);
  seen.phase = event.phase;
  seen.since = event.t;
  if (event.phase === "relay") seen.relayFrom = event.t;
  if (SOMETIMES.has(event.phase) && !phases.querySelector(`[data-phase=${event.phase}]`)) phases.querySelector("[data-phase=quiet]").after(phaseItem(event.phase));
  trend.phase(event.phase, event.t);
  said.textContent = event.phase === "ended" ? "The loop is restored; the result is being computed." : `Phase ${event.phase}`;
  if (event.phase === "restore" || event.phase === "ended") abort.disabled = true;
}

/** The relay's levels and dead zone, as the recording tells them; asked for at the first half periods, and where it was moved. */
function relaySeen(tuning, seen, trend) {
  if (seen.asking || seen.phase !== "relay") return;
  seen.asking = true;
  get(`${tuning.links.self}/curves?most=100`).then(({ settings }) => { if (seen.phase === "relay") trend.relay(settings, seen.relayFrom); }, () => {}).finally(() => { seen.asking = false; });
}

function mark(phases, now) {
  const order = PHASES.indexOf(now === "ended" ? "restore" : now);
  for (const item of phases.children) {
    const at = PHASES.indexOf(item.dataset.phase);
    item.className = at === order && now !== "ended" ? "now" : at <= order ? "past" : "";
    if (at === order) item.setAttribute("aria-current", "step");
    else item.removeAttribute("aria-current");
  }
}

function clock(seen, settings) {
  return [["Elapsed", duration(Math.floor(seen.t))], ["Left, at most", h("span", { "data-left": "" }, left(seen, settings))]];
}

/** The time left at most: by the periods and the check that may still come, else by the time limit; it runs down with each sample. */
function left({ phase, since, t, estimate }, settings) {
  if (phase === "restore" || phase === "ended") return "–";
  const limit = Number.isFinite(settings.time_limit_s) && settings.time_limit_s ? settings.time_limit_s - t : Infinity;
  if (!estimate) return Number.isFinite(limit) ? duration(Math.ceil(limit)) : "measured soon";
  const check = settings.check ? CHECK_PERIODS * estimate.period_s : 0;
  const ahead = phase === "check" ? check - (t - since) : Math.max(0, settings.max_periods - estimate.half_period / 2) * estimate.period_s + check - (t - estimate.at);
  return duration(Math.ceil(Math.max(0, Math.min(limit, ahead))));
}

function progress(seen, loop) {
  const { estimate, model } = seen;
  if (!estimate) return [["Half periods", "0"]];
  const units = { pv: loop.pv_unit, output: loop.output_unit };
  return [
    ["Half periods", String(estimate.half_period)], ["Period Pu", `${number(estimate.period_s)} s`], ["Amplitude A", `${number(estimate.peak)} ${loop.pv_unit}`], ["Ultimate gain Ku", `${number(estimate.ultimate_gain)} ${units.output || "output"}/${units.pv || "PV"}`],
    ...(model ? Object.entries(model.parameters).map(([name, value]) => [`${name} so far`, plusMinus(value, 1.96 * (model.standard_error[name] ?? NaN), unitOf(name, model.structure, units))]) : []),
    model && ["Error of the model", `${number(100 * model.relative_error, 2)} %${model.method ? `, ${METHODS[model.method] ?? model.method}` : ""}`]];
}

/** How near the running model is to the accuracy at which the relay stops; shown once there is a model. */
function accuracyBar(wanted) {
  const bar = h("progress", { class: "bar", max: 1, value: 0, "aria-label": "Accuracy reached, of the accuracy wanted" });
  const text = h("p", { class: "small muted" });
  const element = h("div", { class: "accuracy", hidden: true }, text, bar);
  return {
    element,
    show(error) {
      if (!(error > 0)) return;
      element.hidden = false;
      bar.value = Math.min(1, wanted / error);
      text.textContent = `Accuracy: ${number(100 * error, 2)} % reached, ${number(100 * wanted)} % wanted`;
    },
  };
}

export async function stop(tuning, button, trouble) {
  button.disabled = true;
  button.textContent = "Restoring …";
  try {
    await post(tuning.links.abort);
  } catch (error) {
    if (error.status === 409) return;
    fill(trouble, problemBox(error));
    button.disabled = false;
    button.textContent = ABORT;
  }
}
