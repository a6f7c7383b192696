// Formats numbers for display, and makes elements.

const PREFIXES = [[1e9, 'G'], [1e6, 'M'], [1e3, 'k'], [1, ''], [1e-3, 'm'], [1e-6, 'µ'], [1e-9, 'n'], [1e-12, 'p']];
export const NOTHING = '–';

export function isNumber(x) {
  return typeof x === 'number' && Number.isFinite(x);
}

/** Returns `x` with `digits` decimal places, 0 without a sign, or a dash if it is not a number. */
export function fixed(x, digits = 1) {
  return isNumber(x) ? x.toFixed(digits).replace(/^-([0.]+)$/, '$1') : NOTHING;
}

export function count(x) {
  return isNumber(x) ? Math.round(x).toLocaleString('en') : NOTHING;
}

/** Returns a ratio in percent. */
export function percent(x) {
  return isNumber(x) ? `${Number((100 * x).toPrecision(2))} %` : NOTHING;
}

/** Returns `x` with an SI prefix: 6.5e-10, 'J' becomes "650 pJ". */
export function si(x, unit = '') {
  if (!isNumber(x)) return NOTHING;
  if (x === 0) return `0 ${unit}`.trim();
  const [scale, prefix] = PREFIXES.find(([s]) => Math.abs(x) >= s) ?? PREFIXES[PREFIXES.length - 1];
  return `${Number((x / scale).toPrecision(3))} ${prefix}${unit}`.trim();
}

/** Returns a time in seconds as text: with an SI prefix below a minute, otherwise in minutes or hours. */
export function duration(x) {
  if (!isNumber(x) || x < 60) return si(x, 's');
  return x < 7200 ? `${Math.round(x / 60)} min` : `${fixed(x / 3600)} h`;
}

/** Makes an element with properties and children. */
export function element(tag, properties = {}, ...children) {
  const made = Object.assign(document.createElement(tag), properties);
  made.append(...children);
  return made;
}

/** Sets the text of an element only when it changes, so that a screen reader does not repeat it. */
export function setText(target, text) {
  if (target.textContent !== text) target.textContent = text;
}

/** Returns what people call a robot: the label that names it, or the start of its session's id. */
export function nameOf({labels, session_id: id}) {
  const {robot, name} = labels;
  return robot ?? name ?? id.slice(0, 12);
}

/** Returns how much a robot needs help, and its reasons in words. */
export function needOf({needs_help: need}) {
  if (!need) return [NOTHING, ''];
  const parts = [['unusual observations', need.unusual_observations], ['entropy', need.entropy],
                 ['low return', need.low_return], ['not fresh', need.fallbacks]];
  return [fixed(need.score, 2), parts.filter(([, share]) => share >= 0.005)
    .sort(([, a], [, b]) => b - a).map(([name, share]) => `${name} ${fixed(share, 2)}`).join(', ')];
}

/** Returns the energy of a session's last decision by the first model that applies to it, and the name of the model. */
export function energyOf({energy_joules_per_decision: energies}) {
  const [model, joules] = Object.entries(energies)[0] ?? ['', undefined];
  return [si(joules, 'J'), model];
}

/** Says whether the server is healthy, in the words of its alerts: {good, word, alerts}. */
export function healthOf({serving, alerts}) {
  const of = (state) => alerts.filter((alert) => alert.state === state).length;
  const [firing, pending] = [of('firing'), of('pending')];
  const parts = [];
  if (firing) parts.push(`${firing} alert${firing === 1 ? '' : 's'} firing`);
  if (pending) parts.push(`${pending} pending`);
  return {
    good: serving && firing === 0,
    word: !serving ? 'draining' : firing ? 'not healthy' : 'healthy',
    alerts: parts.join(', ') || `none of ${alerts.length} alerts`,
  };
}

/** Returns the link to the page of a policy version or of a session. */
export function policyLink(policy, version) {
  return `#/policies/${encodeURIComponent(policy)}/${version}`;
}

export function sessionLink(id) {
  return `#/sessions/${encodeURIComponent(id)}`;
}
