// All loops, with state, values and trend; with one loop only, that loop.

import { get } from "../api.js";
import { fill, h, number, problemBox } from "../dom.js";
import { loopView } from "./loop.js";
import { watchBadge } from "./monitoring.js";
import { stateBadge, stateOf, trouble, valuesOf } from "./state.js";
import { Trend } from "./trend.js";

const POLL_MS = 2000;
const HEIGHT = 190;

export async function loopsView(root, signal) {
  const { loops: known } = await get("/v1/loops", signal);
  if (known.length === 1) return loopView(root, signal, known[0].name);
  const cards = h("div", { class: "grid" });
  const place = h("div", {});
  root.append(h("h1", {}, "Loops"), place, cards);
  const shown = new Map();
  while (!signal.aborted) {
    if (!document.hidden) {
      const found = await Promise.all([get("/v1/loops", signal), get("/v1/readings", signal)]).catch((error) => { fill(place, problemBox(error)); return null; });
      if (signal.aborted) return;
      if (found) {
        fill(place);
        const [{ loops }, { readings }] = found;
        if (shown.size !== loops.length) {
          shown.clear();
          fill(cards, loops.map((loop) => { const card = loopCard(loop); shown.set(loop.name, card); return card.element; }));
        }
        const byName = new Map(readings.map((reading) => [reading.loop, reading]));
        for (const loop of loops) shown.get(loop.name)?.update(loop, byName.get(loop.name));
      } else {
        for (const card of shown.values()) card.lost();
      }
    }
    await new Promise((done) => setTimeout(done, POLL_MS));
  }
}

function loopCard(loop) {
  const path = `#/loops/${encodeURIComponent(loop.name)}`;
  const badge = h("span", {}, stateBadge("waiting")), values = h("div", { class: "values" }), note = h("div", {}), watch = h("span", {});
  const action = h("a", { class: "button", href: path }, "Open"), about = h("span", { class: "small muted" }, `${loop.driver}, every ${number(loop.sample_time_s)} s`);
  const trend = new Trend(loop, { idle: true, plain: true, height: HEIGHT });
  const element = h("article", { class: "card loop", "data-loop": loop.name },
    h("h2", {}, h("a", { href: path }, loop.name), badge), values, note, trend.element, h("div", { class: "row" }, action, about, watch));
  const update = (now, reading) => {
    const state = now.tuning_id ? "tuning" : stateOf(reading);
    fill(badge, stateBadge(state));
    fill(values, valuesOf(now, reading));
    trouble(note, now, state, reading);
    fill(watch, watchBadge(reading?.watch));
    action.textContent = now.tuning_id ? "Show the test" : "Open";
    action.href = now.tuning_id ? `#/tunings/${now.tuning_id}` : path;
    if (state === "dead") trend.empty("No link: no readings");
    else if (reading?.at) trend.add({ ...reading, t: Date.parse(reading.at) / 1000 });
  };
  return { element, update, lost: () => fill(badge, stateBadge("lost")) };
}
