// Axes: round numbers to label, and the sample next to a time.

/** Fewest labels of an axis: with fewer nobody can read a value. */
const FEWEST = 3;
/** Steps of an axis that shows the time of day, s. */
const CLOCK_STEPS_S = [1, 2, 5, 10, 15, 30, 60, 120, 300, 600, 900, 1800, 3600, 7200, 21600, 43200, 86400];

/** Round numbers between two, three at least and else at most so many, with texts of equal precision. */
export function ticks(low, high, most) {
  const raw = (high - low) / most;
  const power = 10 ** Math.floor(Math.log10(raw));
  const steps = [0.1, 0.2, 0.25, 0.5, 1, 2, 2.5, 5, 10].map((factor) => factor * power);
  const fits = (step) => Math.floor(high / step + 1e-9) - Math.ceil(low / step - 1e-9) + 1;
  const wide = steps.findIndex((candidate) => candidate >= raw * 0.999);
  const step = steps.slice(0, wide + 1).reverse().find((candidate) => fits(candidate) >= FEWEST) ?? steps[0];
  const finer = /^2\.5/.test(step.toExponential(3)) ? 1 : 0;
  const decimals = Math.min(12, Math.max(0, finer - Math.floor(Math.log10(step) + 1e-9)));
  const found = [];
  for (let k = Math.ceil(low / step - 1e-9); k * step <= high + 1e-9 * step; k += 1) {
    const value = k * step;
    found.push({ value, text: Math.abs(value) >= 1e6 ? value.toExponential(1) : value.toFixed(decimals) });
  }
  return found;
}

/** A time of day, s since the epoch, in the reader's own zone: hours, minutes and seconds, or without what is left out. */
export function timeOfDay(t, { seconds = true, hours = true } = {}) {
  const when = new Date(1000 * t), two = (value) => String(value).padStart(2, "0");
  return [hours && two(when.getHours()), two(when.getMinutes()), seconds && two(when.getSeconds())].filter(Boolean).join(":");
}

/** Round times of day between two, s since the epoch; `narrow`: seconds are shown without the hour. */
export function timeTicks(from, to, most, narrow) {
  const wide = CLOCK_STEPS_S.find((candidate) => (to - from) / candidate <= most) ?? CLOCK_STEPS_S.at(-1);
  const fits = (step) => Math.floor(to / step) - Math.ceil(from / step) + 1;
  const step = CLOCK_STEPS_S.filter((candidate) => candidate <= wide).reverse().find((candidate) => fits(candidate) >= FEWEST) ?? 1;
  const shown = { seconds: step < 60, hours: step >= 60 || !narrow };
  const found = [];
  for (let value = Math.ceil(from / step) * step; value <= to; value += step) found.push({ value, text: timeOfDay(value, shown) });
  return found;
}

/** A value as a read-out shows it. */
export function reading(value) {
  return value === null || value === undefined || !Number.isFinite(value) ? "–" : Number(value.toPrecision(5)).toString();
}

/** Index of the first time not below `value`. */
export function lower(times, value) {
  let low = 0, high = times.length;
  while (low < high) {
    const middle = (low + high) >> 1;
    if (times[middle] < value) low = middle + 1;
    else high = middle;
  }
  return low;
}

/** Index of the time next to `value`. */
export function nearest(times, value) {
  const after = Math.min(times.length - 1, lower(times, value));
  return after > 0 && value - times[after - 1] < times[after] - value ? after - 1 : after;
}
