// The settings of a test, what it will do, and its start.

import { Problem, get, post } from "../api.js";
import { duration, fill, h, number, problemBox } from "../dom.js";

const FIELDS = [
  { name: "amplitude", label: "Amplitude", unit: "output", hint: "Half of the relay's swing. The PV must move well beyond its noise.", suggested: (loop) => loop.relay.amplitude ?? (loop.limits.output[1] - loop.limits.output[0]) / 10 },
  { name: "hysteresis", label: "Hysteresis", unit: "pv", hint: "Half width of the band in which the relay does not switch.", suggested: (loop) => loop.relay.hysteresis ?? "3 × noise" },
  { name: "accuracy", label: "Accuracy", hint: "Relative standard error of period and amplitude at which the relay stops.", suggested: (loop) => loop.relay.accuracy },
  { name: "ratio", label: "Asymmetry", hint: "Upper over lower part of the swing; 1 is symmetric and cannot show the static gain.", suggested: (loop) => loop.relay.ratio },
];
const MORE = [
  { name: "quiet_s", label: "Time at rest, s", hint: "How long noise is measured first.", suggested: (loop) => loop.relay.quiet_s ?? 50 * loop.sample_time_s },
  { name: "min_periods", label: "Fewest periods", whole: true, suggested: (loop) => loop.relay.min_periods },
  { name: "max_periods", label: "Most periods", whole: true, suggested: (loop) => loop.relay.max_periods },
  { name: "response_limit_s", label: "Longest wait for a response, s", suggested: (loop) => loop.relay.response_limit_s },
  { name: "time_limit_s", label: "Time limit, s", suggested: (loop) => loop.relay.time_limit_s },
];
const SPECIFICATION = [
  { name: "Ms", label: "Largest sensitivity Ms", hint: "Instead of the goal's: 1.2 is very calm, 2 is the most that is wise.", suggested: () => "by the goal" },
  { name: "tau_c_s", label: "Closed-loop time constant, s", hint: "As far as that is robust.", suggested: () => "the shortest" },
  { name: "jitter", label: "Output movement limit", unit: "output", hint: "Standard deviation that noise and resolution may cause.", suggested: () => "by the goal" },
];
const CHOICES = {
  controller: [["PID", "PID"], ["PI", "PI"], ["P", "P"]],
  purpose: [["load", "disturbances"], ["set_point", "set-point changes"]],
  goal: [["balanced", "balanced: the usual choice"], ["calm", "calm: more robust, slower"], ["brisk", "brisk: faster, less robust"]],
  structure: [["auto", "found from the record"], ["fopdt", "first order"], ["sopdt_overdamped", "second order, overdamped"], ["sopdt_underdamped", "second order, underdamped"], ["integrating", "integrating"], ["unstable_fopdt", "unstable, first order"], ["inverse_response", "inverse response"], ["inverse_response_underdamped", "inverse response, damped pair"], ["n_lags", "equal lags"], ["third_order", "third order"], ["third_order_underdamped", "third order, damped pair"]],
};
const CHECK_PERIODS = 7;
const AFTER_INPUT_MS = 250;
/** Change of the output for which the plan is asked for again. */
const MOVED = 1e-3;

/**
 * The form (`element`), its button (`start`) with a line that says why that is off (`why`), `block` with a reason, and
 * `present` for the output that the loop shows.
 */
export function startForm(loop, signal) {
  const plan = h("div", { "aria-live": "polite" }), problems = h("div", {}), started = h("div", {});
  const why = h("p", { class: "small muted", role: "status" });
  const start = h("button", { class: "main", type: "submit", form: "test-settings", disabled: true, "data-start": "" }, "Start tuning …");
  const form = settingsForm(loop, [h("h3", {}, "What the test will do"), plan, problems]);
  const state = { output: null, period: null, turn: 0, timer: 0, blocked: "Waiting for the first reading.", refused: false };
  const mark = () => { start.disabled = Boolean(state.blocked) || state.refused; if (why.textContent !== state.blocked) why.textContent = state.blocked; };
  const refresh = async () => {
    const turn = (state.turn += 1);
    const result = await planOf(loop, state.output, bodyOf(form)).catch((error) => error);
    if (turn !== state.turn || signal.aborted) return;
    const refused = result instanceof Error;
    if (!refused) fill(plan, planned(result, loop, state.period));
    fill(problems, refused ? problemBox(result) : null);
    state.refused = refused && result instanceof Problem && result.status === 422;
    mark();
  };
  const soon = () => { clearTimeout(state.timer); state.timer = setTimeout(refresh, AFTER_INPUT_MS); };
  form.addEventListener("input", soon);
  form.addEventListener("submit", (event) => { event.preventDefault(); if (!start.disabled) confirmStart(loop, bodyOf(form), plan, started); });
  lastPeriod(loop, signal).then((period) => { state.period = period; if (period) refresh(); });
  refresh();
  return {
    element: form, start, why: h("div", {}, why, started),
    block(reason) { state.blocked = reason; mark(); },
    present(output) {
      if (!Number.isFinite(output) || Math.abs((state.output ?? Infinity) - output) <= MOVED) return;
      const first = state.output === null;
      state.output = output;
      if (first) refresh();
      else soon();
    },
  };
}

const planOf = (loop, output, body) => post(`/v1/loops/${encodeURIComponent(loop.name)}/plan${output === null ? "" : `?output=${output}`}`, body);

function settingsForm(loop, below) {
  const choice = (name, label, wide) => h("label", { class: wide ? "wide" : null }, label, h("select", { name }, CHOICES[name].map(([value, text]) => h("option", { value }, text))));
  const box = (name, label, hint) => h("label", { class: "check" }, h("input", { type: "checkbox", name, checked: loop.relay[name] }), h("span", {}, label, h("span", { class: "hint" }, hint)));
  const fields = (rows, ...others) => h("div", { class: "fields" }, rows.map((row) => field(loop, row)), others);
  return h("form", { class: "card", id: "test-settings", novalidate: true, "aria-label": "Test settings" },
    h("h2", {}, "Test settings"), h("p", { class: "small muted" }, "An empty field takes the value shown in grey."),
    fields(FIELDS, choice("goal", "Goal of the gains", true), choice("structure", "Process", true)),
    h("details", {}, h("summary", {}, "Gains: more settings"), fields(SPECIFICATION, choice("controller", "Controller"), choice("purpose", "Designed for"))),
    h("details", {}, h("summary", {}, "Test: more settings"), fields(MORE)),
    box("drift_compensation", "Compensate a drifting PV", "Instead of refusing it."),
    box("check", "Check for dead-band and friction", "Smaller moves after the relay, within its levels."), below);
}

function field(loop, { name, label, unit, hint, suggested, whole }) {
  const shown = suggested(loop);
  const units = { pv: loop.pv_unit, output: loop.output_unit }[unit];
  return h("label", {}, `${label}${units ? `, ${units}` : ""}`,
    h("input", { name, type: "number", step: whole ? "1" : "any", inputmode: "decimal", placeholder: typeof shown === "number" ? number(shown) : shown }),
    hint ? h("span", { class: "hint" }, hint) : null);
}

function bodyOf(form) {
  const given = [...FIELDS, ...SPECIFICATION, ...MORE].map(({ name }) => [name, form.elements[name].value]).filter(([, value]) => value !== "");
  const chosen = Object.keys(CHOICES).map((name) => [name, form.elements[name].value]);
  const boxes = ["check", "drift_compensation"].map((name) => [name, form.elements[name].checked]);
  return { ...Object.fromEntries(given.map(([name, value]) => [name, Number(value)])), ...Object.fromEntries([...chosen, ...boxes]) };
}

/** The period of the oscillation in the last tuning of the loop that found one, s; null where there is none. */
async function lastPeriod(loop, signal) {
  try {
    const { tunings } = await get(`/v1/tunings?loop=${encodeURIComponent(loop.name)}&limit=5`, signal);
    const last = tunings.find((tuning) => tuning.outcome === "done");
    return last ? (await get(last.links.self, signal)).limit_cycle?.Pu ?? null : null;
  } catch {
    return null;
  }
}

function planned(plan, loop, period) {
  return [
    h("ol", { class: "steps" }, plan.steps.map((step) => h("li", {}, h("b", {}, step.phase), ": ", step.text))),
    plan.levels?.one_sided ? h("p", { class: "notice warn" }, "The output is near a limit: it is first moved away from it, until there is room to oscillate.") : null,
    h("p", { class: "small muted" }, `${howLong(plan, period)} Never longer than ${duration(plan.longest_s)}. The limits of loop ${loop.name} hold throughout.`),
  ];
}

function howLong(plan, period) {
  const { min_periods: fewest, max_periods: most, check } = plan.settings;
  const more = check ? CHECK_PERIODS : 0;
  if (period) return `About ${duration(plan.quiet_s + (fewest + 1 + more) * period)}, ${duration(plan.quiet_s + (most + 1 + more) * period)} at most, if the loop oscillates as in its last tuning, with a period of ${number(period, 3)} s.`;
  return `${duration(plan.quiet_s)} at rest, then ${fewest} to ${most} periods of oscillation${check ? `, and about ${more} more for the check` : ""}; the first tuning of a loop shows how long a period is.`;
}

function confirmStart(loop, body, plan, place) {
  fill(place);
  const key = crypto.randomUUID?.() ?? String(Math.random());
  const go = h("button", { class: "main", type: "button" }, "Start");
  const dialog = h("dialog", { "aria-labelledby": "confirm-title" },
    h("h2", { id: "confirm-title" }, `Start the test of ${loop.name}?`),
    h("p", {}, "The output is moved:"), plan.querySelector("ol")?.cloneNode(true) ?? null,
    h("p", {}, "Stay with the loop. Abort is on every page."),
    h("div", { class: "row end" }, h("button", { type: "button", onclick: () => dialog.close() }, "Cancel"), go));
  go.addEventListener("click", async () => {
    go.disabled = true;
    try {
      const tuning = await post(`/v1/loops/${encodeURIComponent(loop.name)}/tunings`, body, { "Idempotency-Key": key });
      dialog.close();
      location.hash = `#/tunings/${tuning.id}`;
    } catch (error) {
      dialog.close();
      fill(place, problemBox(error), error.tuning_id ? h("p", {}, h("a", { href: `#/tunings/${error.tuning_id}` }, "Show the tuning that holds the loop")) : null);
    }
  });
  dialog.addEventListener("close", () => dialog.remove());
  document.body.append(dialog);
  dialog.showModal();
  go.focus();
}
