// Gains into the device and back: what it holds now beside what it would hold, confirmed first, read back afterwards.

import { get, post } from "../api.js";
import { facts, fill, h, number, problemBox, table } from "../dom.js";

const shownAs = (title, told) => h("div", { class: "notice done", "data-applied": title }, h("strong", {}, title),
  facts(Object.entries(told.now.values).map(([name, value]) => [`${name} read back`, number(value, 6)])), (told.warnings ?? []).map((text) => h("p", {}, text)));

/** The part of the gains that writes them; a sentence where the configuration does not tell how. */
export function deviceActions(tuning, choices, loop) {
  if (!loop?.gains || !tuning.links.apply) return h("p", { class: "small muted" }, "Enter the gains in the device by hand: the configuration does not tell where it keeps them.");
  const usable = choices.filter((choice) => choice.device);
  if (!usable.length) return h("p", { class: "notice warn" }, "The device cannot hold these gains in its form.");
  const which = h("select", { id: "which-gains" }, usable.map((choice) => h("option", { value: choice.name }, choice.name)));
  const asked = tuning.tuning?.goal ?? tuning.tuning?.rule;
  which.value = usable.some((choice) => choice.name === asked) ? asked : usable[0].name;
  const outcome = h("div", { "aria-live": "polite" });
  const attempt = async (work) => { try { fill(outcome, await work()); } catch (error) { fill(outcome, problemBox(error)); } };
  const chosen = () => usable.find((choice) => choice.name === which.value);
  const button = (text, enabled, ask) => h("button", { class: text === "Apply …" ? "main" : null, disabled: !enabled, onclick: ask }, text);
  const told = (enabled) => { verify.disabled = back.disabled = !enabled; };
  const apply = button("Apply …", true, async () => sure(`Write the ${which.value} gains to ${tuning.loop}?`, await nowAndNew(tuning, chosen()), "Write them",
    () => attempt(async () => { const done = await post(tuning.links.apply, chosen().asked); told(true); return shownAs("Written and read back", done); })));
  const verify = button("Verify …", tuning.applied, () => sure(`Move the set point of ${tuning.loop} by a small step?`,
    h("p", {}, "The device's controller makes a step that stands out of the noise, under the gains written. Unless the loop does as predicted, the old gains are put back."), "Make the step",
    () => attempt(async () => { fill(outcome, h("p", { class: "notice" }, "The step is under way …")); const done = await post(tuning.links.verify, {}); if (done.rolled_back) told(false); return verified(done); })));
  const back = button("Roll back …", tuning.applied, () => sure(`Put the gains of ${tuning.loop} back?`, h("p", {}, "The device gets the gains that it had before these were written."), "Put them back",
    () => attempt(async () => { const done = await post(tuning.links.rollback); told(false); return shownAs("Put back and read back", done); })));
  return h("div", {}, h("h3", {}, "In the device"), h("div", { class: "row" }, h("label", { for: "which-gains" }, "Gains"), h("div", {}, which), apply, verify, back), outcome);
}

function verified(done) {
  return h("div", { class: `notice ${done.passed ? "done" : "failed"}`, "data-verified": String(done.passed) }, h("strong", {}, done.passed ? "The loop did as predicted" : "The loop did not do as predicted"),
    done.verdict ? h("p", {}, `${done.verdict.message} ${done.verdict.remedy}`.trim()) : null, done.rolled_back ? h("p", {}, "The old gains are back.") : null);
}

/** What the device holds now beside what it would hold; the new ones alone where it does not answer. */
async function nowAndNew(tuning, choice) {
  const held = await get(`${tuning.links.loop}/gains`).catch(() => null);
  const before = new Map(Object.entries(held?.values ?? {}).map(([name, value]) => [name.toLowerCase(), value]));
  const rows = Object.entries(choice.device.values).map(([name, value]) => [name, number(before.get(name.toLowerCase()), 6), number(value, 6)]);
  return table("Numbers of the device", ["", "Now", "New"], rows);
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
