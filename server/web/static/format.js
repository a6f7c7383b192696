// Formats numbers for display.

const PREFIXES = [[1e9, 'G'], [1e6, 'M'], [1e3, 'k'], [1, ''], [1e-3, 'm'], [1e-6, 'µ'], [1e-9, 'n'], [1e-12, 'p']];
export const NOTHING = '–';

export function isNumber(x) {
  return typeof x === 'number' && Number.isFinite(x);
}

/** Returns `x` with `digits` decimal places, or a dash if it is not a number. */
export function fixed(x, digits = 1) {
  return isNumber(x) ? x.toFixed(digits) : NOTHING;
}

export function count(x) {
  return isNumber(x) ? Math.round(x).toLocaleString('en') : NOTHING;
}

/** Returns `x` with an SI prefix: 6.5e-10, 'J' becomes "650 pJ". */
export function si(x, unit) {
  if (!isNumber(x)) return NOTHING;
  if (x === 0) return `0 ${unit}`.trim();
  const [scale, prefix] = PREFIXES.find(([s]) => Math.abs(x) >= s) ?? PREFIXES[PREFIXES.length - 1];
  return `${Number((x / scale).toPrecision(3))} ${prefix}${unit}`.trim();
}

/** Returns a quantile of a histogram as text. null means that it lies beyond the last finite bucket bound. */
export function seconds(x) {
  return x === null ? 'off scale' : si(x, 's');
}
