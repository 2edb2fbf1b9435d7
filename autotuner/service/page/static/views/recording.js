// A recording from elsewhere: dropped here, identified by the service; nothing is moved.

import { upload } from "../api.js";
import { fill, h, problemBox } from "../dom.js";
import { beforeAfterCard, diagnosisCard } from "./diagnosis.js";
import { fitCard, gainsCard, modelCard, remarks, verdictBox } from "./result.js";

const KINDS = [["identifications", "Identify: which process is it?"], ["diagnoses", "Diagnose: what does a model of it lack?"]];

const UNITS = { pv: "", output: "" };
const SHOWN = {
  identifications: (told) => [
    told.verdict ? verdictBox(told.verdict) : null,
    remarks([...(told.warnings ?? []), ...(told.notes ?? [])]),
    modelCard(told, UNITS), told.curves ? fitCard(told.curves, UNITS) : null, told.choices?.length ? gainsCard(told.choices, "balanced", UNITS) : null],
  diagnoses: (told) => [diagnosisCard(told, UNITS), told.curves ? beforeAfterCard(told.curves, UNITS) : null],
};

export async function recordingView(root, signal) {
  const result = h("div", { "aria-live": "polite" });
  const kind = h("select", { name: "kind" }, KINDS.map(([value, text]) => h("option", { value }, text)));
  const file = h("input", { type: "file", accept: ".csv,text/csv,text/plain", id: "file" });
  const drop = h("div", { class: "drop" }, h("label", { for: "file" }, "Drop a CSV file here, or choose one"), file,
    h("p", { class: "small muted" }, "One row a sample, with a header: time t in s or as a date, output u, PV y, and sp where there was a set point. Other common names are known too."));
  root.append(h("h1", {}, "A recording from elsewhere"),
    h("div", { class: "card" }, h("label", {}, "What to do with it", kind), h("p", {}), drop), result);
  const take = async (chosen) => {
    if (!chosen) return;
    fill(result, h("p", { class: "notice", role: "status" }, `${chosen.name} is being worked on …`));
    const wanted = kind.value;
    try {
      const told = await upload(`/v1/${wanted}?points=4000`, chosen, signal);
      fill(result, h("h2", {}, chosen.name), SHOWN[wanted](told));
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
