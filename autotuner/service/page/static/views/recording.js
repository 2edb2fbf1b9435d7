// A recording from elsewhere: dropped here, identified by the service; nothing is moved.

import { upload } from "../api.js";
import { fill, h, problemBox } from "../dom.js";
import { diagnosisCard, fitCard, gainsCard, modelCard, verdictBox } from "./result.js";

const KINDS = [["identifications", "Identify: which process is it?"], ["diagnoses", "Diagnose: what does a model of it lack?"]];

export async function recordingView(root, signal) {
  const result = h("div", { "aria-live": "polite" });
  const kind = h("select", { name: "kind" }, KINDS.map(([value, text]) => h("option", { value }, text)));
  const file = h("input", { type: "file", accept: ".csv,text/csv,text/plain", id: "file" });
  const drop = h("div", { class: "drop" }, h("p", {}, "Drop a CSV file here, or choose one."), file,
    h("p", { class: "small muted" }, "One row a sample, with a header: time t in s or as a date, output u, PV y, and sp where there was a set point. Other common names are known too."));
  root.append(h("h1", {}, "A recording from elsewhere"),
    h("div", { class: "card" }, h("label", {}, "What to do with it", kind), h("p", {}), drop), result);
  const take = async (chosen) => {
    if (!chosen) return;
    fill(result, h("p", { class: "notice" }, `${chosen.name} is being worked on …`));
    try {
      const told = await upload(`/v1/${kind.value}?points=4000`, chosen, signal);
      fill(result, told.verdict ? verdictBox(told.verdict) : null, (told.warnings ?? []).map((text) => h("p", { class: "notice warn" }, text)),
        (told.notes ?? []).map((text) => h("p", { class: "notice" }, text)),
        modelCard(told, { pv: "", output: "" }), told.choices?.length ? gainsCard(told.choices, "balanced", { pv: "", output: "" }) : null,
        kind.value === "diagnoses" ? diagnosisCard(told.diagnosis ?? told) : null, told.curves ? fitCard(told.curves, { pv: "", output: "" }) : null);
    } catch (error) {
      if (!signal.aborted) fill(result, problemBox(error));
    }
  };
  file.addEventListener("change", () => take(file.files[0]));
  for (const [name, over] of [["dragover", true], ["dragleave", false]]) {
    drop.addEventListener(name, (event) => { event.preventDefault(); drop.classList.toggle("over", over); });
  }
  drop.addEventListener("drop", (event) => { event.preventDefault(); drop.classList.remove("over"); take(event.dataTransfer.files[0]); });
}
