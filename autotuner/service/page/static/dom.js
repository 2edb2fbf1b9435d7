// Making elements, and telling numbers. Text goes in as text nodes only: nothing from a device becomes markup.

/** Make an element: attributes by name, `on...` as listeners, children as text or elements; null is left out. */
export function h(tag, attributes = {}, ...children) {
  const element = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (value === null || value === undefined || value === false) continue;
    if (name.startsWith("on")) element.addEventListener(name.slice(2), value);
    else if (name === "value" || name === "checked" || name === "disabled") element[name] = value;
    else element.setAttribute(name, value === true ? "" : value);
  }
  element.append(...children.flat(3).filter((child) => child !== null && child !== undefined && child !== false));
  return element;
}

/** Replace what an element holds. */
export function fill(element, ...children) {
  element.replaceChildren(...children.flat(3).filter((child) => child !== null && child !== undefined && child !== false));
}

/** A number with so many significant digits, without a tail of zeros; an en dash for none. */
export function number(value, digits = 4) {
  if (value === null || value === undefined || !Number.isFinite(value)) return "–";
  if (value === 0) return "0";
  const magnitude = Math.abs(value);
  if (magnitude >= 1e6 || magnitude < 1e-4) return value.toExponential(digits - 1);
  const decimals = Math.max(0, digits - 1 - Math.floor(Math.log10(magnitude)));
  const text = value.toFixed(Math.min(decimals, 12));
  return text.includes(".") ? text.replace(/\.?0+$/, "") : text;
}

/** A value and half of its 95 % interval, to the digits that mean something. */
export function plusMinus(value, half, unit = "") {
  if (!Number.isFinite(half) || half <= 0) return `${number(value)}${unit && ` ${unit}`}`;
  const decimals = Math.min(12, Math.max(0, 1 - Math.floor(Math.log10(half))));
  return `${value.toFixed(decimals)} ± ${half.toFixed(decimals)}${unit && ` ${unit}`}`;
}

/** Seconds as people say them. */
export function duration(seconds) {
  if (!Number.isFinite(seconds)) return "–";
  if (seconds < 120) return `${number(seconds, seconds < 10 ? 2 : 3)} s`;
  if (seconds < 7200) return `${Math.floor(seconds / 60)} min ${Math.round(seconds % 60)} s`;
  return `${number(seconds / 3600, 3)} h`;
}

/** A moment in the reader's own time. */
export function moment(iso) {
  const when = new Date(iso);
  if (Number.isNaN(when.getTime())) return String(iso);
  const two = (value) => String(value).padStart(2, "0");
  return `${when.getFullYear()}-${two(when.getMonth() + 1)}-${two(when.getDate())} ${[when.getHours(), when.getMinutes(), when.getSeconds()].map(two).join(":")}`;
}

/** `name: description` pairs as a definition list. */
export function facts(rows) {
  return h("dl", { class: "facts" }, rows.filter(Boolean).map(([name, ...value]) => h("div", {}, h("dt", {}, name), h("dd", {}, ...value))));
}

/** A cell of a table's head; one that says nothing is no header. */
export const headCell = (cell) => (cell === "" ? h("td", {}) : h("th", { scope: "col" }, cell));

/** A table with a caption; cells are text or elements. */
export function table(caption, head, rows, attributes = {}) {
  return h("div", { class: "scroll", tabindex: "0", role: "region", "aria-label": caption },
    h("table", attributes,
      h("caption", {}, caption),
      h("thead", {}, h("tr", {}, head.map(headCell))),
      h("tbody", {}, rows.map((row) => h("tr", {}, row.map((cell, index) => (index ? h("td", {}, cell) : h("th", { scope: "row" }, cell))))))));
}

/** What went wrong, and what to do about it. */
export function problemBox(problem) {
  return h("div", { class: "notice bad", role: "alert" },
    h("strong", {}, problem.title || "That did not work"),
    h("p", {}, problem.detail || String(problem)),
    problem.remedy && !String(problem.detail).includes(problem.remedy) ? h("p", {}, problem.remedy) : null);
}
