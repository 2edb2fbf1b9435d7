// One tuning: live while it runs, its result when it has ended.

import { follow, get, open, post } from "../api.js";
import { duration, facts, fill, h, moment, number, plusMinus, problemBox } from "../dom.js";
import { diagnosisCard, fitCard, gainsCard, modelCard, verdictBox } from "./result.js";
import { Trend } from "./trend.js";

const PHASES = ["arm", "quiet", "approach", "relay", "check", "restore"];
const SOMETIMES = new Set(["approach"]);

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
}

function liveView(tuning, loop) {
  const trend = new Trend(loop, 430);
  const relative = h("progress", { class: "bar", max: 1, value: 0, "aria-label": "Accuracy reached" });
  const numbers = h("div", {});
  const said = h("p", { class: "visually-hidden", "aria-live": "polite" });
  const link = h("div", {});
  const phases = h("ol", { class: "phases", "aria-label": "Phases" }, PHASES.filter((name) => !SOMETIMES.has(name)).map((name) => h("li", { "data-phase": name }, name)));
  const abort = h("button", { class: "abort", onclick: () => stop() }, "Abort and give the loop back");
  const trouble = h("div", {});
  const seen = { phase: "arm", t: 0, halfPeriods: 0, estimate: null, model: null, low: Infinity, high: -Infinity, relayFrom: null, accuracy: tuning.settings.accuracy, error: NaN };
  const stop = async () => {
    abort.disabled = true;
    abort.textContent = "Giving the loop back …";
    try {
      await post(tuning.links.abort);
    } catch (error) {
      if (error.status !== 409) { fill(trouble, problemBox(error)); abort.disabled = false; abort.textContent = "Abort and give the loop back"; }
    }
  };
  const takers = {
    sample(event) {
      seen.t = event.t;
      trend.add(event);
      if (seen.phase === "relay") {
        seen.low = Math.min(seen.low, event.output);
        seen.high = Math.max(seen.high, event.output);
        trend.relayBand(seen.low, seen.high, seen.relayFrom);
      }
    },
    phase(event) {
      if (event.phase === seen.phase && seen.started) return;
      seen.started = true;
      if (seen.phase === "relay") trend.relayBand(seen.low, seen.high, seen.relayFrom, event.t);
      seen.phase = event.phase;
      if (event.phase === "relay") seen.relayFrom = event.t;
      if (SOMETIMES.has(event.phase) && !phases.querySelector(`[data-phase=${event.phase}]`)) phases.querySelector("[data-phase=quiet]").after(h("li", { "data-phase": event.phase }, event.phase));
      trend.phase(event.phase, event.t);
      said.textContent = event.phase === "ended" ? "The loop has been given back; the result is being computed." : `Phase ${event.phase}`;
      if (event.phase === "restore" || event.phase === "ended") abort.disabled = true;
    },
    estimate(event) { seen.estimate = event; seen.halfPeriods = event.half_period; },
    model(event) { seen.model = event; seen.error = event.relative_error; },
    link(event) { fill(link, h("p", { class: "notice warn" }, event.message)); },
    output_unknown(event) { fill(link, h("p", { class: "notice bad", role: "alert" }, `The output is not known (attempt ${event.attempts}): ${event.message}`)); },
    restored(event) { fill(link, h("p", { class: "notice done" }, `The output is back at ${number(event.output)} ${loop.output_unit}${event.verified ? ", read back" : ", not read back"}.`)); },
  };
  const refresh = () => {
    const order = PHASES.indexOf(seen.phase === "ended" ? "restore" : seen.phase);
    for (const item of phases.children) {
      const at = PHASES.indexOf(item.dataset.phase);
      item.className = at === order && seen.phase !== "ended" ? "now" : at <= order ? "past" : "";
      if (at === order) item.setAttribute("aria-current", "step");
      else item.removeAttribute("aria-current");
    }
    const { estimate, model } = seen;
    if (Number.isFinite(seen.error) && seen.error > 0) relative.value = Math.min(1, seen.accuracy / seen.error);
    fill(numbers, facts([
      ["Time", duration(seen.t)], ["Half periods", String(seen.halfPeriods)],
      estimate && ["Period Pu", `${number(estimate.period_s)} s`], estimate && ["Amplitude A", `${number(estimate.peak)} ${loop.pv_unit}`], estimate && ["Ultimate gain Ku", number(estimate.ultimate_gain)],
      ...(model ? Object.entries(model.parameters).map(([name, value]) => [`${name} so far`, plusMinus(value, 1.96 * (model.standard_error[name] ?? NaN))]) : []),
      model && ["Error of the model", `${number(100 * model.relative_error, 2)} %`]]));
  };
  const element = h("div", {}, said,
    h("section", { class: "card", "aria-label": "Progress" },
      h("div", { class: "row" }, phases, abort), link, trouble, numbers, h("p", { class: "small muted" }, "Accuracy reached of what is wanted"), relative),
    h("section", { class: "card", "aria-label": "Live trend" }, h("h2", {}, "Live"), trend.element));
  return {
    element, refresh,
    take: (event) => takers[event.type]?.(event),
    connected: (stands) => { if (!stands) fill(trouble, h("p", { class: "notice bad" }, "The connection was lost; it is made again. The tuning goes on by itself.")); else fill(trouble); },
  };
}

async function ended(place, id, loop, signal) {
  const tuning = await get(`/v1/tunings/${encodeURIComponent(id)}`, signal);
  const units = { pv: loop?.pv_unit ?? "", output: loop?.output_unit ?? "" };
  const pictures = h("div", {});
  const gains = h("div", {});
  const files = h("div", { class: "row" },
    tuning.links.report ? h("button", { onclick: () => open(tuning.links.report) }, "Report") : null,
    h("button", { onclick: () => open(tuning.links.recording, `${tuning.id}.csv`) }, "Recording (CSV)"),
    h("button", { onclick: () => open(tuning.links.self, `${tuning.id}.json`) }, "Result (JSON)"),
    loop ? h("a", { class: "button", href: `#/loops/${encodeURIComponent(tuning.loop)}` }, "Tune again") : null);
  fill(place,
    tuning.verdict ? verdictBox(tuning.verdict) : h("p", { class: "notice" }, "It still runs."),
    tuning.restored === false ? h("p", { class: "notice bad", role: "alert" }, "The output could not be confirmed at its value before. Check the device.") : null,
    (tuning.warnings ?? []).map((text) => h("p", { class: "notice warn" }, text)),
    files, h("p", {}), gains, modelCard(tuning, units), diagnosisCard(tuning.diagnosis), pictures, howItRan(tuning, units));
  if (tuning.samples > 1) get(`/v1/tunings/${id}/curves`, signal).then((curves) => fill(pictures, fitCard(curves, units)), (error) => signal.aborted || fill(pictures, problemBox(error)));
  if (tuning.model) {
    const show = async () => {
      const { choices } = await get(`/v1/tunings/${id}/choices`, signal);
      fill(gains, gainsCard(choices, tuning.tuning?.rule === "robust" ? tuning.tuning?.goal : tuning.tuning?.rule, units, applying(tuning, choices, loop)));
    };
    show().catch((error) => signal.aborted || fill(gains, problemBox(error)));
  }
}

function howItRan(tuning, units) {
  const { settings } = tuning;
  return h("section", { class: "card", "aria-label": "How it ran" }, h("h2", {}, "How it ran"), facts([
    ["Samples", String(tuning.samples)], ["Output before", tuning.before ? `${number(tuning.before.output)} ${units.output}` : "–"],
    ["Given back", tuning.restored === true ? "yes" : tuning.restored === false ? "not confirmed" : "not known"],
    ["Lateness, 99 %", tuning.lateness ? `${number(1000 * tuning.lateness.p99_s, 2)} ms` : "–"],
    ["Amplitude", settings.amplitude === null ? "suggested" : `${number(settings.amplitude)} ${units.output}`], ["Check", settings.check ? "yes" : "left out"],
    ["Output limits", settings.limits?.output?.map((value) => number(value)).join(" to ")]]));
}

function applying(tuning, choices, loop) {
  if (!loop?.gains || !tuning.links.apply) return h("p", { class: "small muted" }, "Enter the gains in the device by hand: the configuration does not tell where it keeps them.");
  const usable = choices.filter((choice) => choice.device);
  if (!usable.length) return h("p", { class: "notice warn" }, "The device cannot hold these gains in its form.");
  const which = h("select", { "aria-label": "Which gains" }, usable.map((choice) => h("option", { value: choice.name }, choice.name)));
  which.value = usable.some((choice) => choice.name === tuning.tuning?.goal) ? tuning.tuning.goal : usable[0].name;
  const outcome = h("div", { "aria-live": "polite" });
  const shown = (title, told) => h("div", { class: "notice done", "data-applied": title }, h("strong", {}, title),
    facts(Object.entries(told.now.values).map(([name, value]) => [`${name} read back`, number(value, 6)])), (told.warnings ?? []).map((text) => h("p", {}, text)));
  const attempt = async (work) => { try { fill(outcome, await work()); } catch (error) { fill(outcome, problemBox(error)); } };
  const apply = h("button", { class: "main", onclick: () => sure(`Write the ${which.value} gains to ${tuning.loop}?`,
    facts(Object.entries(usable.find((choice) => choice.name === which.value).device.values).map(([name, value]) => [name, number(value, 6)])), "Write them",
    () => attempt(async () => { const choice = choices.find(({ name }) => name === which.value); const told = await post(tuning.links.apply, choice.goal ? { goal: choice.goal } : { rule: choice.rule }); back.disabled = false; return shown("Written and read back", told); })) }, "Apply …");
  const back = h("button", { disabled: !tuning.applied, onclick: () => sure(`Put the gains of ${tuning.loop} back?`, h("p", {}, "The device gets the gains that it had before these were written."), "Put them back",
    () => attempt(async () => { const told = await post(tuning.links.rollback); back.disabled = true; return shown("Put back and read back", told); })) }, "Roll back …");
  return h("div", {}, h("h3", {}, "In the device"), h("div", { class: "row" }, h("label", { class: "row" }, "Gains", which), apply, back), outcome);
}

function sure(question, detail, answer, work) {
  const go = h("button", { class: "main", type: "button" }, answer);
  const dialog = h("dialog", { "aria-label": question }, h("h2", {}, question), detail,
    h("div", { class: "row end" }, h("button", { type: "button", onclick: () => dialog.close() }, "Not now"), go));
  go.addEventListener("click", async () => { dialog.close(); await work(); });
  dialog.addEventListener("close", () => dialog.remove());
  document.body.append(dialog);
  dialog.showModal();
  go.focus();
}
