// A tuning while it runs: phases, the running estimate with its shrinking interval, the trend, and the abort.

import { get, post } from "../api.js";
import { duration, facts, fill, h, number, plusMinus, problemBox } from "../dom.js";
import { METHODS } from "./result.js";
import { Trend } from "./trend.js";

const PHASES = ["arm", "quiet", "approach", "relay", "check", "restore"];
const SOMETIMES = new Set(["approach"]);
const ABORT = "Abort and give the loop back";
const CHECK_PERIODS = 7;

/** What is shown of a running tuning: `element`, `take` for an event, `refresh`, `connected`. */
export function liveView(tuning, loop) {
  const trend = new Trend(loop, 430);
  const seen = { phase: "arm", t: 0, relayFrom: null, estimate: null, model: null, known: null };
  const said = h("p", { class: "visually-hidden", "aria-live": "polite" });
  const numbers = h("div", {}), link = h("div", {}), trouble = h("div", {});
  const phases = h("ol", { class: "phases", "aria-label": "Phases" }, PHASES.filter((name) => !SOMETIMES.has(name)).map(phaseItem));
  const accuracy = accuracyBar(tuning.settings.accuracy);
  const abort = h("button", { class: "abort", onclick: () => stop(tuning, abort, trouble) }, ABORT);
  const takers = {
    sample(event) { seen.t = event.t; trend.add(event); if (seen.phase === "relay") trend.swing(event.output, seen.relayFrom); },
    phase(event) { enter(event, seen, phases, trend, said, abort); },
    estimate(event) { seen.estimate = event; relaySeen(tuning, seen, trend); },
    model(event) { seen.model = event; accuracy.show(event.relative_error); },
    link(event) { fill(link, h("p", { class: "notice warn" }, event.message)); },
    output_unknown(event) { fill(link, h("p", { class: "notice bad", role: "alert" }, `The output is not known (attempt ${event.attempts}): ${event.message}`)); },
    restored(event) { fill(link, h("p", { class: "notice done" }, `The output is back at ${number(event.output)} ${loop.output_unit}${event.verified ? ", read back" : ", not read back"}. The result is being computed.`)); },
  };
  const element = h("div", {}, said,
    h("section", { class: "card", "aria-label": "Progress" }, h("div", { class: "row" }, phases, abort), link, trouble, numbers, accuracy.element),
    h("section", { class: "card", "aria-label": "Live trend" }, h("h2", {}, "Live"), trend.element));
  return {
    element,
    take: (event) => takers[event.type]?.(event),
    refresh: () => { mark(phases, seen.phase); fill(numbers, facts(progress(seen, tuning, loop))); },
    connected: (stands) => (stands ? fill(trouble) : fill(trouble, h("p", { class: "notice bad" }, "The connection was lost; it is made again. The tuning goes on by itself."))),
  };
}

const phaseItem = (name) => h("li", { "data-phase": name }, name);

function enter(event, seen, phases, trend, said, abort) {
  if (event.phase === seen.phase && seen.entered) return;
  seen.entered = true;
  if (seen.phase === "relay") trend.bandsEnd(event.t);
  seen.phase = event.phase;
  if (event.phase === "relay") seen.relayFrom = event.t;
  if (SOMETIMES.has(event.phase) && !phases.querySelector(`[data-phase=${event.phase}]`)) phases.querySelector("[data-phase=quiet]").after(phaseItem(event.phase));
  trend.phase(event.phase, event.t);
  said.textContent = event.phase === "ended" ? "The loop has been given back; the result is being computed." : `Phase ${event.phase}`;
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

function progress(seen, tuning, loop) {
  const { estimate, model } = seen;
  return [
    ["Time", duration(seen.t)], ["Half periods", String(estimate?.half_period ?? 0)],
    estimate && ["Left, at most about", left(seen, tuning.settings)],
    estimate && ["Period Pu", `${number(estimate.period_s)} s`], estimate && ["Amplitude A", `${number(estimate.peak)} ${loop.pv_unit}`], estimate && ["Ultimate gain Ku", number(estimate.ultimate_gain)],
    ...(model ? Object.entries(model.parameters).map(([name, value]) => [`${name} so far`, plusMinus(value, 1.96 * (model.standard_error[name] ?? NaN))]) : []),
    model && ["Error of the model", `${number(100 * model.relative_error, 2)} %${model.method ? `, ${METHODS[model.method] ?? model.method}` : ""}`]];
}

function left(seen, settings) {
  if (seen.phase === "restore" || seen.phase === "ended") return "–";
  const relay = seen.phase === "relay" ? Math.max(0, settings.max_periods - seen.estimate.half_period / 2) : 0;
  return duration((relay + (settings.check ? CHECK_PERIODS : 0)) * seen.estimate.period_s);
}

function accuracyBar(wanted) {
  const bar = h("progress", { class: "bar", max: 1, value: 0, "aria-label": "Accuracy reached, of what is wanted" });
  const text = h("span", {}, "not known before the second half period");
  return {
    element: h("div", { class: "accuracy" }, h("p", { class: "small muted" }, `Accuracy reached of the ${number(100 * wanted)} % that are wanted: `, text), bar),
    show(error) {
      if (!(error > 0)) return;
      bar.value = Math.min(1, wanted / error);
      text.textContent = `${number(100 * error, 2)} %`;
    },
  };
}

async function stop(tuning, button, trouble) {
  button.disabled = true;
  button.textContent = "Giving the loop back …";
  try {
    await post(tuning.links.abort);
  } catch (error) {
    if (error.status === 409) return;
    fill(trouble, problemBox(error));
    button.disabled = false;
    button.textContent = ABORT;
  }
}
