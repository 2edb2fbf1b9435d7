// A table in a text file: separators, decimal commas and a header are found; columns are chosen, scaled and written anew.

const SEPARATORS = [",", ";", "\t"];
/** Lines by which the separator is found. */
const LOOKED_AT = 20;

/** {head, rows}: names of the columns, and cells as texts; an error in words where there is no table. */
export function tableOf(text) {
  const lines = text.replace(/^\uFEFF/, "").split(/\r?\n/).filter((line) => line.trim() && !line.startsWith("#"));
  if (lines.length < 3) throw new Error("The file has fewer than three lines.");
  const separator = SEPARATORS.map((one) => [one, Math.min(...lines.slice(0, LOOKED_AT).map((line) => line.split(one).length))]).sort((a, b) => b[1] - a[1])[0];
  if (separator[1] < 2) throw new Error("The file has one column only; separate columns by comma, semicolon or tab.");
  const cells = lines.map((line) => line.split(separator[0]).map((cell) => cell.trim().replace(/^"(.*)"$/, "$1")));
  const headed = cells[0].some((cell) => cell !== "" && Number.isNaN(numberOf(cell)) && Number.isNaN(Date.parse(cell)));
  const head = cells[0].map((cell, index) => (headed ? cell : `column ${index + 1}`));
  return { head, rows: headed ? cells.slice(1) : cells };
}

/** A cell as a number, with a decimal point or comma; NaN where it is none. */
export function numberOf(cell) {
  return cell === undefined || cell === "" ? NaN : Number(cell.includes(".") ? cell : cell.replace(",", "."));
}

/** Seconds of the cells of a column: numbers times `scale`, or dates where `scale` is null. */
export function secondsOf(rows, column, scale) {
  return rows.map((row) => (scale === null ? Date.parse(row[column]) / 1000 : scale * numberOf(row[column])));
}
