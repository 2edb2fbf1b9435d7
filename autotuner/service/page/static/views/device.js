// The gains of a tuning on the first screen: as the device states them, what the loop will do, and the buttons that
// write, verify and restore. What is written is confirmed first and read back afterwards; buttons that cannot work are off.

import { get, post } from "../api.js";
import { facts, fill, h, number, problemBox, table } from "../dom.js";
import { actions } from "./loop.js";
import { remarks } from "./result.js";
import { followVerification, verificationCard } from "./verification.js";

const READ_BACK_DIGITS = 6;
const LOOK_MS = 400;

/** The card of the gains: `element`, `verification` for the step, and `offer` for those of all goals once computed. */
export function gainsInDevice(tuning, loop, units, signal) {
  const chosen = fromTuning(tuning);
  const parts = { values: h("div", {}), outcome: h("div", { "aria-live": "polite" }), why: h("p", { class: "small muted" }), verification: h("div", {}) };
  const state = { tuning, loop, units, signal, choices: [chosen], applied: tuning.applied, busy: false, parts };
  const which = h("select", { "aria-label": "Goal of the gains", onchange: () => refresh(state, which) }, h("option", { value: chosen.name }, chosen.name));
  state.buttons = buttonsOf(state, which);
  const element = h("section", { class: "card summary", "aria-label": "Gains to apply" },
    h("div", { class: "row" }, h("h2", {}, "Gains"), h("label", { class: "inline" }, "Goal", which), ...Object.values(state.buttons)),
    parts.values, parts.why, parts.outcome);
  refresh(state, which);
  if (tuning.verification?.state === "running") watchStep(state, which);
  else fill(parts.verification, verificationCard(tuning.verification, units));
  return { element, verification: parts.verification, offer(choices) {
    state.choices = choices;
    const name = which.value;
    fill(which, choices.map((choice) => h("option", { value: choice.name }, choice.name)));
    which.value = choices.some((choice) => choice.name === name) ? name : choices[0]?.name;
    refresh(state, which);
  } };
}

/** The gains that the tuning itself recommends, as one of the choices. */
const fromTuning = ({ tuning: design }) => ({ ...design, name: design.goal ?? design.rule, asked: design.goal ? { goal: design.goal } : { rule: design.rule } });

function refresh(state, which) {
  const choice = state.choices.find((one) => one.name === which.value) ?? state.choices[0];
  state.choice = choice;
  fill(state.parts.values, stated(choice, state));
  const why = cannot(state, choice);
  fill(state.parts.why, [why.apply, why.verify, why.restore].filter(Boolean)[0] ?? "");
  state.buttons.apply.disabled = Boolean(why.apply);
  state.buttons.verify.disabled = Boolean(why.apply || why.verify);
  state.buttons.restore.disabled = Boolean(why.apply || why.restore);
}

/** Why each of the buttons is off; the first that is true is shown. */
function cannot({ tuning, loop, applied, busy }, choice) {
  const apply = busy ? "A write or a verification is under way."
    : !loop?.gains ? "Enter these gains in the device by hand: the configuration has no [gains] table for this loop."
    : !choice.device ? "The device cannot hold these gains in its form."
    : !tuning.current ? "This tuning is of an earlier run of the service: its gains are written with `autotuner apply`, or tune again."
    : tuning.verdict?.outcome !== "done" ? "Gains of a tuning that did not end well are not written." : "";
  const verify = !loop?.can_verify ? "Verify is off: set_point, output and auto of the device's controller are not all configured." : !applied ? "Verify and Restore are on once the gains are applied." : "";
  return { apply, verify, restore: applied ? "" : "Restore is on once the gains are applied." };
}

function stated(choice, { units, loop }) {
  const { device, predicted, margins } = choice, held = device?.gains ?? choice.gains;
  const numbers = device ? Object.entries(device.values) : [["Kp", held.Kp], ["Ti, s", held.Ti], ["Td, s", held.Td]];
  const about = device ? `As the device states them: ${device.form} form, ${actions(loop.process_action)}, set-point weight b ${number(held.b, 3)}` : `Ideal form, ${held.controller}, set-point weight b ${number(held.b, 3)}, filter Tf ${number(held.Tf, 3)} s`;
  const overshoot = predicted?.overshoot ?? choice.overshoot;
  return [
    h("div", { class: "values gains", "data-gains": "" }, numbers.map(([name, value]) => h("div", { class: "value" }, h("span", {}, name), h("b", {}, number(value, 5))))),
    h("p", { class: "small muted" }, about),
    facts([["Overshoot, predicted", Number.isFinite(overshoot) ? `${number(100 * overshoot, 2)} %` : "–"], ["Settling time, predicted", Number.isFinite(predicted?.settling_time_s) ? `${number(predicted.settling_time_s, 3)} s` : "–"],
      ["Robustness Ms", number(margins?.Ms, 3)], ["Output movement", Number.isFinite(choice.jitter) && choice.jitter !== null ? `${number(choice.jitter, 2)} ${units.output}` : "no noise measured"]]),
    remarks([...new Set([...choice.warnings, ...(device?.warnings ?? [])])])];
}

function buttonsOf(state, which) {
  const { tuning, parts } = state;
  const attempt = async (work) => {
    state.busy = true;
    refresh(state, which);
    try { fill(parts.outcome, await work()); } catch (error) { fill(parts.outcome, problemBox(error)); }
    state.busy = false;
    refresh(state, which);
  };
  const button = (text, look, act) => h("button", { type: "button", class: look, disabled: true, onclick: act }, text);
  return {
    apply: button("Apply …", "main", async () => sure(`Write the ${state.choice.name} gains to ${tuning.loop}?`, await nowAndNew(tuning, state.choice), "Write", () => attempt(async () => {
      state.applied = await post(tuning.links.apply, state.choice.asked);
      return written("Written and read back", state.applied);
    }))),
    verify: button("Verify …", null, () => sure(`Step the set point of ${tuning.loop}?`, h("p", {}, "The device's controller makes a small step under the gains written. Unless the loop does as predicted, the gains before are restored."), "Step", () => attempt(() => verify(state, which)))),
    restore: button("Restore gains …", null, () => sure(`Restore the gains of ${tuning.loop}?`, h("p", {}, "The device gets the gains that it had before."), "Restore", () => attempt(async () => {
      const back = await post(tuning.links.rollback);
      state.applied = null;
      return written("Restored and read back", back);
    }))),
  };
}

const written = (title, told) => h("div", { class: "notice done", "data-applied": title }, h("strong", {}, title),
  facts(Object.entries(told.now.values).map(([name, value]) => [`${name} read back`, number(value, READ_BACK_DIGITS)])), (told.warnings ?? []).map((text) => h("p", {}, text)));

/** Make the step and show it while it runs; the outcome is in the card of the verification. */
async function verify(state, which) {
  const { tuning, signal } = state, before = tuning.verification?.started_at;
  const work = post(tuning.links.verify, {});
  let ended = false;
  work.then(() => { ended = true; }, () => { ended = true; });
  while (!ended && !signal.aborted) {
    const now = await get(tuning.links.self, signal);
    if (now.verification && now.verification.started_at !== before) { await watchStep(state, which); break; }
    await new Promise((done) => setTimeout(done, LOOK_MS));
  }
  await work;
  return null;
}

async function watchStep(state, which) {
  const { tuning, units, signal, parts } = state;
  state.busy = true;
  refresh(state, which);
  parts.verification.scrollIntoView({ block: "nearest" });
  await followVerification(parts.verification, tuning, units, signal);
  if (signal.aborted) return;
  const now = await get(tuning.links.self, signal);
  Object.assign(tuning, { verification: now.verification, applied: now.applied });
  state.applied = now.applied;
  state.busy = false;
  fill(parts.verification, verificationCard(now.verification, units));
  refresh(state, which);
}

/** What the device holds now beside what it would hold; the new ones alone where it does not answer. */
async function nowAndNew(tuning, choice) {
  const held = await get(`${tuning.links.loop}/gains`).catch(() => null);
  const before = new Map(Object.entries(held?.values ?? {}).map(([name, value]) => [name.toLowerCase(), value]));
  const rows = Object.entries(choice.device.values).map(([name, value]) => [name, number(before.get(name.toLowerCase()), READ_BACK_DIGITS), number(value, READ_BACK_DIGITS)]);
  return table("Numbers of the device", ["", "Now", "New"], rows);
}

function sure(question, detail, answer, work) {
  const go = h("button", { class: "main", type: "button" }, answer);
  const dialog = h("dialog", { "aria-label": question }, h("h2", {}, question), detail,
    h("div", { class: "row end" }, h("button", { type: "button", onclick: () => dialog.close() }, "Cancel"), go));
  go.addEventListener("click", async () => { dialog.close(); await work(); });
  dialog.addEventListener("close", () => dialog.remove());
  document.body.append(dialog);
  dialog.showModal();
  go.focus();
}
