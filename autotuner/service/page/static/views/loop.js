// One loop: its trend, and the form that starts a tuning.

import { Problem, get, post } from "../api.js";
import { duration, facts, fill, h, number, problemBox } from "../dom.js";
import { history } from "./tunings.js";
import { Trend } from "./trend.js";
import { watching } from "./watching.js";

const POLL_MS = 1000;
const FIELDS = [
  { name: "amplitude", label: "Amplitude", unit: "output", hint: "Half of the relay's swing. Small is gentle; the PV must move well beyond its noise.", suggested: (loop) => loop.relay.amplitude ?? (loop.limits.output[1] - loop.limits.output[0]) / 10 },
  { name: "hysteresis", label: "Hysteresis", unit: "pv", hint: "Half width of the band in which the relay does not switch.", suggested: (loop) => loop.relay.hysteresis ?? "3 × noise" },
  { name: "accuracy", label: "Accuracy", hint: "Relative standard error of period and amplitude at which the relay stops.", suggested: (loop) => loop.relay.accuracy },
  { name: "ratio", label: "Asymmetry", hint: "Upper over lower part of the swing; 1 is symmetric and cannot show the static gain.", suggested: (loop) => loop.relay.ratio },
];
const MORE = [
  { name: "quiet_s", label: "Time at rest, s", hint: "How long the loop is watched first.", suggested: (loop) => loop.relay.quiet_s ?? 50 * loop.sample_time_s },
  { name: "min_periods", label: "Fewest periods", whole: true, suggested: (loop) => loop.relay.min_periods },
  { name: "max_periods", label: "Most periods", whole: true, suggested: (loop) => loop.relay.max_periods },
  { name: "response_limit_s", label: "Longest wait for an answer, s", suggested: (loop) => loop.relay.response_limit_s },
  { name: "time_limit_s", label: "Longest time in all, s", suggested: (loop) => loop.relay.time_limit_s },
];
const WISHES = [
  { name: "Ms", label: "Largest sensitivity Ms", hint: "Instead of the goal's: 1.2 is very calm, 2 is the most that is wise.", suggested: () => "by the goal" },
  { name: "tau_c_s", label: "Closed-loop time, s", hint: "Wanted time constant, as far as that is robust.", suggested: () => "the shortest" },
  { name: "jitter", label: "Allowed output jitter", unit: "output", hint: "Standard deviation that the noise may cause.", suggested: () => "any" },
];
const CONTROLLERS = [["PID", "PID"], ["PI", "PI"], ["P", "P"]];
const PURPOSES = [["load", "disturbances"], ["set_point", "set-point changes"]];
const GOALS = [["balanced", "balanced: the usual choice"], ["calm", "calm: more robust, slower"], ["brisk", "brisk: faster, less robust"]];
const STRUCTURES_ASKED = [["auto", "found from the record"], ["fopdt", "first order"], ["sopdt_overdamped", "second order, overdamped"], ["sopdt_underdamped", "second order, underdamped"], ["integrating", "integrating"], ["unstable_fopdt", "unstable, first order"], ["inverse_response", "inverse response"], ["inverse_response_underdamped", "inverse response, damped pair"]];
const CHECK_PERIODS = 7;

export async function loopView(root, signal, name) {
  const loop = await get(`/v1/loops/${encodeURIComponent(name)}`, signal);
  if (loop.tuning_id) {
    location.replace(`#/tunings/${loop.tuning_id}`);
    return;
  }
  const trend = new Trend(loop, 300);
  const state = h("p", { class: "small muted" }, "Waiting for a first reading.");
  const form = startForm(loop, signal);
  const past = h("div", { class: "card" });
  const held = h("div", {}), watched = h("div", {});
  root.append(
    h("p", { class: "crumbs" }, h("a", { href: "#/" }, "Loops"), " / "), h("h1", {}, loop.name),
    h("div", { class: "split" },
      h("div", {}, h("section", { class: "card", "aria-label": "Trend" }, h("h2", {}, "Now"), state, trend.element), watched, held, past,
        h("p", {}, h("a", { href: `#/audit/${encodeURIComponent(name)}` }, "Who did what to this loop")), configured(loop)),
      form.element));
  history(past, `/v1/tunings?loop=${encodeURIComponent(name)}`, signal).catch((error) => signal.aborted || fill(past, problemBox(error)));
  watching(watched, loop, signal).catch((error) => signal.aborted || fill(watched, problemBox(error)));
  if (loop.gains) deviceGains(loop, held, signal);
  await readings(loop, trend, state, form, signal);
}

/** The gains that the device holds now, by its own names. */
async function deviceGains(loop, place, signal) {
  const told = await get(loop.links.gains, signal).catch((error) => (signal.aborted ? null : { error }));
  if (!told) return;
  const shown = told.error ? h("p", { class: "small muted" }, told.error.message) : facts(Object.entries(told.values).map(([name, value]) => [name, number(value, 6)]));
  fill(place, h("section", { class: "card", "aria-label": "Gains in the device" }, h("h2", {}, "Gains in the device now"), shown));
}

function configured(loop) {
  const [low, high] = loop.limits.output;
  return h("section", { class: "card" }, h("h2", {}, "Configured"), facts([
    ["Driver", loop.driver], ["Sample time", `${number(loop.sample_time_s)} s`], ["Action", loop.action],
    ["Output limits", `${number(low)} to ${number(high)} ${loop.output_unit}`],
    ["PV limits", loop.limits.pv ? `${number(loop.limits.pv[0])} to ${number(loop.limits.pv[1])} ${loop.pv_unit}` : "none"],
    ["Output slew", loop.limits.output_slew_per_s ? `${number(loop.limits.output_slew_per_s)} ${loop.output_unit}/s` : "not limited"],
    ["Safe output", loop.limits.safe_output === null ? "the output before" : number(loop.limits.safe_output)],
    ["Form of the gains", loop.gains ? loop.gains.form : "not told"]]));
}

async function readings(loop, trend, state, form, signal) {
  let origin = null;
  let fresh = false; // the first answer tells the look before, which may be long ago
  while (!signal.aborted) {
    if (!document.hidden) {
      const { readings: [reading] } = await get(`/v1/readings?loop=${encodeURIComponent(loop.name)}`, signal).catch(() => ({ readings: [] }));
      if (reading?.error) state.textContent = reading.error;
      else if (reading?.at && fresh) {
        origin ??= Date.parse(reading.at);
        trend.add({ ...reading, t: (Date.parse(reading.at) - origin) / 1000 });
        form.present(reading.output);
        state.textContent = `PV ${number(reading.pv, 5)} ${loop.pv_unit}, output ${number(reading.output, 5)} ${loop.output_unit}${reading.auto === 1 ? ", automatic" : reading.auto === 0 ? ", manual" : ""}`;
      }
      fresh = true;
      if (reading?.tuning_id) location.replace(`#/tunings/${reading.tuning_id}`);
    }
    await new Promise((done) => setTimeout(done, POLL_MS));
  }
}

function field(loop, { name, label, unit, hint, suggested, whole }) {
  const shown = suggested(loop);
  const units = { pv: loop.pv_unit, output: loop.output_unit }[unit];
  return h("label", {}, `${label}${units ? `, ${units}` : ""}`,
    h("input", { name, type: "number", step: whole ? "1" : "any", inputmode: "decimal", placeholder: typeof shown === "number" ? number(shown) : shown }),
    hint ? h("span", { class: "hint" }, hint) : null);
}

function startForm(loop, signal) {
  const plan = h("div", { "aria-live": "polite" });
  const earlier = { period: null };
  lastPeriod(loop, signal).then((period) => { earlier.period = period; if (period) refresh(); });
  const trouble = h("div", {}), started = h("div", {});
  const goal = h("select", { name: "goal" }, GOALS.map(([value, text]) => h("option", { value }, text)));
  const [controller, purpose] = [["controller", CONTROLLERS], ["purpose", PURPOSES]].map(([name, rows]) => h("select", { name }, rows.map(([value, text]) => h("option", { value }, text))));
  const structure = h("select", { name: "structure" }, STRUCTURES_ASKED.map(([value, text]) => h("option", { value }, text)));
  const drift = h("input", { type: "checkbox", name: "drift_compensation", checked: loop.relay.drift_compensation });
  const check = h("input", { type: "checkbox", name: "check", checked: loop.relay.check });
  const start = h("button", { class: "main", type: "submit" }, "Start the test …");
  const form = h("form", { class: "card", novalidate: true, "aria-label": "Start a tuning" },
    h("h2", {}, "Tune this loop"),
    h("p", { class: "small muted" }, "What is left empty is taken as shown in grey."),
    h("div", { class: "fields" }, FIELDS.map((one) => field(loop, one)), h("label", { class: "wide" }, "Goal of the gains", goal), h("label", { class: "wide" }, "Process", structure)),
    h("details", {}, h("summary", {}, "More about the gains"), h("div", { class: "fields" }, WISHES.map((one) => field(loop, one)), h("label", {}, "Controller", controller), h("label", {}, "Made for", purpose))),
    h("details", {}, h("summary", {}, "More settings"), h("div", { class: "fields" }, MORE.map((one) => field(loop, one)))),
    h("label", { class: "check" }, drift, h("span", {}, "Follow a PV that drifts at rest", h("span", { class: "hint" }, "Instead of refusing it."))),
    h("label", { class: "check" }, check, h("span", {}, "Check for what a relay does not show", h("span", { class: "hint" }, "Dead-band, friction and the like: smaller moves after the relay, within its levels."))),
    h("h3", {}, "What the test will do"), plan, trouble, h("div", { class: "row end" }, start), started);
  let output = null;
  let latest = 0;
  const body = () => {
    const given = [...FIELDS, ...WISHES, ...MORE].map(({ name }) => [name, form.elements[name].value]).filter(([, value]) => value !== "");
    return { ...Object.fromEntries(given.map(([name, value]) => [name, Number(value)])), goal: goal.value, controller: controller.value, purpose: purpose.value, structure: structure.value, check: check.checked, drift_compensation: drift.checked };
  };
  const refresh = async () => {
    const turn = (latest += 1);
    const query = output === null ? "" : `?output=${output}`;
    try {
      const told = await post(`/v1/loops/${encodeURIComponent(loop.name)}/plan${query}`, body());
      if (turn !== latest || signal.aborted) return;
      fill(plan, planned(told, loop, earlier.period));
      fill(trouble);
      start.disabled = false;
    } catch (error) {
      if (turn !== latest || signal.aborted) return;
      fill(trouble, problemBox(error));
      start.disabled = error instanceof Problem && error.status === 422;
    }
  };
  let timer = 0;
  form.addEventListener("input", () => { clearTimeout(timer); timer = setTimeout(refresh, 250); });
  form.addEventListener("submit", (event) => { event.preventDefault(); fill(started); confirmStart(loop, body(), plan, started); });
  refresh();
  return { element: form, present: (now) => { const first = output === null; if (Number.isFinite(now) && Math.abs((output ?? Infinity) - now) > 1e-3) { output = now; if (first || !latest) refresh(); else { clearTimeout(timer); timer = setTimeout(refresh, 250); } } } };
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

function planned(told, loop, period) {
  return [
    h("ol", { class: "steps" }, told.steps.map((step) => h("li", {}, h("b", {}, step.phase), ": ", step.text))),
    told.levels?.one_sided ? h("p", { class: "notice warn" }, "The output stands near a limit: it is first pushed off it, until there is room to oscillate.") : null,
    h("p", { class: "small muted" }, `${howLong(told, period)} Never longer than ${duration(told.longest_s)}. The limits of loop ${loop.name} hold throughout.`),
  ];
}

function howLong(told, period) {
  const { min_periods: fewest, max_periods: most, check } = told.settings;
  const more = check ? CHECK_PERIODS : 0;
  if (period) return `About ${duration(told.quiet_s + (fewest + 1 + more) * period)}, ${duration(told.quiet_s + (most + 1 + more) * period)} at most, if the loop oscillates as in its last tuning, with a period of ${number(period, 3)} s.`;
  return `It takes ${duration(told.quiet_s)} at rest, then ${fewest} to ${most} periods of oscillation of the loop${check ? `, and about ${more} more for the check` : ""}; how long a period is, its first tuning shows.`;
}

function confirmStart(loop, body, plan, trouble) {
  const key = crypto.randomUUID?.() ?? String(Math.random());
  const go = h("button", { class: "main", type: "button" }, "Start now");
  const dialog = h("dialog", { "aria-labelledby": "confirm-title" },
    h("h2", { id: "confirm-title" }, `Move the output of ${loop.name}?`),
    plan.querySelector("ol")?.cloneNode(true) ?? null,
    h("p", {}, "Stay with the loop. The abort is on every page."),
    h("div", { class: "row end" }, h("button", { type: "button", onclick: () => dialog.close() }, "Not now"), go));
  go.addEventListener("click", async () => {
    go.disabled = true;
    try {
      const tuning = await post(`/v1/loops/${encodeURIComponent(loop.name)}/tunings`, body, { "Idempotency-Key": key });
      dialog.close();
      location.hash = `#/tunings/${tuning.id}`;
    } catch (error) {
      dialog.close();
      fill(trouble, problemBox(error), error.tuning_id ? h("p", {}, h("a", { href: `#/tunings/${error.tuning_id}` }, "Show the tuning in the way")) : null);
    }
  });
  dialog.addEventListener("close", () => dialog.remove());
  document.body.append(dialog);
  dialog.showModal();
  go.focus();
}
