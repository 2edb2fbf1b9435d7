// All loops, with what they show now.

import { get } from "../api.js";
import { fill, h, number, problemBox } from "../dom.js";
import { watchBadge } from "./watching.js";

const POLL_MS = 2000;

export async function loopsView(root, signal) {
  const cards = h("div", { class: "grid" });
  const trouble = h("div", {});
  root.append(h("h1", {}, "Loops"), trouble, cards);
  const shown = new Map();
  while (!signal.aborted) {
    if (!document.hidden) {
      const found = await Promise.all([get("/v1/loops", signal), get("/v1/readings", signal)]).catch((error) => { fill(trouble, problemBox(error)); return null; });
      if (signal.aborted) return;
      if (!found) {
        await new Promise((done) => setTimeout(done, POLL_MS));
        continue;
      }
      fill(trouble);
      const [{ loops }, { readings }] = found;
      if (shown.size !== loops.length) {
        shown.clear();
        fill(cards, loops.map((loop) => { const card = loopCard(loop); shown.set(loop.name, card); return card.element; }));
      }
      const byName = new Map(readings.map((reading) => [reading.loop, reading]));
      for (const loop of loops) shown.get(loop.name)?.update(loop, byName.get(loop.name));
    }
    await new Promise((done) => setTimeout(done, POLL_MS));
  }
}

function loopCard(loop) {
  const pv = h("b", {}, "–"), output = h("b", {}, "–"), state = h("span", { class: "badge" }, "idle"), note = h("p", { class: "small muted" }), watch = h("span", {});
  const path = `#/loops/${encodeURIComponent(loop.name)}`;
  const action = h("a", { class: "button", href: path }, "Open");
  const element = h("article", { class: "card loop", "data-loop": loop.name },
    h("h2", {}, h("a", { href: path }, loop.name), state),
    h("div", { class: "values" },
      h("div", { class: "value pv" }, h("span", {}, "PV"), pv),
      h("div", { class: "value output" }, h("span", {}, "Output"), output)),
    note, h("div", { class: "row" }, action, watch));
  const show = (where, value, unit) => fill(where, number(value, 5), unit && h("small", {}, unit));
  const update = (now, reading) => {
    const busy = Boolean(now.tuning_id);
    state.textContent = busy ? "tuning" : reading?.error ? "no link" : "idle";
    state.className = `badge ${busy ? "running" : reading?.error ? "failed" : ""}`;
    show(pv, reading?.pv, now.pv_unit);
    show(output, reading?.output, now.output_unit);
    fill(watch, watchBadge(reading?.watch));
    action.textContent = busy ? "Watch" : "Open";
    action.href = busy ? `#/tunings/${now.tuning_id}` : path;
    note.textContent = reading?.error ?? `${now.driver}, sampled every ${number(now.sample_time_s)} s${reading?.auto === 1 ? ", automatic" : reading?.auto === 0 ? ", manual" : ""}`;
  };
  return { element, update };
}
