// The tiles with the main figures, each with a sparkline, and the list of alerts.
import {NOTHING, count, duration, element, fixed, healthOf, isNumber, nameOf, percent, policyLink, sessionLink, setText, si} from './format.js';

const SVG = 'http://www.w3.org/2000/svg';
const WIDTH = 120;
const HEIGHT = 28;
const BRIDGED = 6;  // missing values in a row that a line crosses; more are a gap

/** Draws values, of which some may be null, as a line from the left to the right edge. */
export function drawSparkline(svg, values) {
  const known = values.filter(isNumber);
  const low = Math.min(0, ...known);
  const high = Math.max(...known, low + 1e-30);
  let path = '';
  let pen = 'M';
  let missing = 0;
  values.forEach((value, i) => {
    if (!isNumber(value)) {
      missing += 1;
      return;
    }
    if (missing > BRIDGED) pen = 'M';
    missing = 0;
    const x = values.length < 2 ? WIDTH : i / (values.length - 1) * WIDTH;
    path += `${pen}${x.toFixed(1)} ${(HEIGHT - 2 - (value - low) / (high - low) * (HEIGHT - 4)).toFixed(1)}`;
    pen = 'L';
  });
  svg.firstChild.setAttribute('d', path);
}

function sparkline() {
  const svg = document.createElementNS(SVG, 'svg');
  svg.setAttribute('viewBox', `0 0 ${WIDTH} ${HEIGHT}`);
  svg.setAttribute('preserveAspectRatio', 'none');
  svg.setAttribute('aria-hidden', 'true');
  svg.append(document.createElementNS(SVG, 'path'));
  return svg;
}

/** A grid of tiles. Each has a label, a value, a quiet line, and optionally a sparkline. */
export class TileGrid {
  constructor(target) {
    this.target = target;
    this.tiles = new Map();  // by label
  }

  /** tiles: a list of {label, value, note, line, bad}. `line` is a list of numbers. */
  show(tiles) {
    const labels = tiles.map(({label}) => label);
    if (labels.join() !== [...this.tiles.keys()].join()) this.build(labels);
    for (const {label, value, note, line, bad} of tiles) {
      const tile = this.tiles.get(label);
      setText(tile.value, value);
      setText(tile.note, note ?? '');
      tile.box.classList.toggle('alarm', Boolean(bad));
      if (line) drawSparkline(tile.svg, line);
      tile.svg.classList.toggle('none', !line);
    }
  }

  build(labels) {
    this.tiles = new Map(labels.map((label) => {
      const tile = {value: element('dd', {className: 'value'}), note: element('dd', {className: 'quiet'}), svg: sparkline()};
      tile.box = element('div', {}, element('dt', {textContent: label}), tile.value, tile.note, tile.svg);
      return [label, tile];
    }));
    this.target.replaceChildren(...[...this.tiles.values()].map(({box}) => box));
  }
}

/** Returns true if one of the alerts fires for the route: all of the server, or one policy version. */
function fires(status, route, ...names) {
  return status.alerts.some((alert) => names.includes(alert.name) && alert.instances.some(({state, labels}) =>
    state === 'firing' && (!route.policy || !labels.policy ||
                           (labels.policy === route.policy && labels.version === route.version))));
}

/** The main figures of the server, or of the policy version that the route names. */
export class Tiles {
  constructor(target) {
    this.grid = new TileGrid(target);
  }

  show(status, history, route, model) {
    if (route.session) return;
    const same = (row) => row.policy === route.policy && row.version === route.version;
    const figures = route.policy ? status.versions.find(same) : status.figures;
    if (!figures) {
      this.grid.show([{label: 'Version', value: 'not served', note: 'It was unloaded, or never existed.'}]);
      return;
    }
    const lines = (route.policy ? history?.versions.find(same) : history?.server) ?? {};
    this.grid.show(route.policy ? versionTiles(figures, lines, model, status, route)
                                : serverTiles(figures, lines, model, status));
  }
}

/** Returns true if episodes of several tasks ended in the window: their returns have no common scale. */
function mixesTasks(status, route) {
  if (route.policy) return false;
  const tasks = new Map(status.policies.map((info) => [`${info.name}/${info.version}`, info.environment]));
  const ended = status.versions.filter(({episodes}) => episodes > 0);
  return new Set(ended.map(({policy, version}) => tasks.get(`${policy}/${version}`))).size > 1;
}

/** Returns the energy that the decisions of the route would have taken with dense policies of the same sizes, a decision. */
function denseEnergy(status, route, model) {
  const rows = status.versions.filter(({policy, version, decisions}) =>
    (route.policy ? policy === route.policy && version === route.version : decisions > 0));
  const weigh = (row) => (route.policy ? 1 : row.decisions);
  const joules = rows.reduce((sum, row) => sum + weigh(row) * row.dense_energy_joules_per_decision[model], 0);
  return joules / rows.reduce((sum, row) => sum + weigh(row), 0);
}

function commonTiles(figures, lines, model, status, route) {
  const bad = (...names) => fires(status, route, ...names);
  return {
    decisions: {label: 'Decisions / s', value: si(figures.decisions_per_second),
                note: `${si(figures.decisions)} in all`, line: lines.decisions_per_second,
                bad: bad('SpikeserveNoDecisions')},
    returns: mixesTasks(status, route)
      ? {label: 'Episode return', value: NOTHING, note: 'their tasks differ', bad: bad('SpikeserveReturnFalling')}
      : {label: 'Episode return', value: fixed(figures.return_mean),
              note: figures.episodes > 0 ? `${count(figures.episodes)} episode${figures.episodes === 1 ? '' : 's'}` : 'no episode ended',
              line: lines.return_mean, bad: bad('SpikeserveReturnFalling')},
    spikes: {label: 'Spikes / decision', value: fixed(figures.spikes_per_decision),
             note: `${percent(figures.unusual_per_decision)} unusual`, line: lines.spikes_per_decision,
             bad: bad('SpikeserveUnusualObservations')},
    energy: {label: 'Energy / decision', value: si(figures.energy_joules_per_decision[model], 'J'),
             note: `dense: ${si(denseEnergy(status, route, model), 'J')}`,
             line: lines.energy_joules_per_second?.[model]?.map((power, i) => power / lines.decisions_per_second[i])},
  };
}

function serverTiles(figures, lines, model, status) {
  const bad = (...names) => fires(status, {}, ...names);
  const {decisions, returns, spikes, energy} = commonTiles(figures, lines, model, status, {});
  const health = healthOf(status);
  return [
    {label: 'Health', value: health.word, note: health.alerts, bad: !health.good},
    {label: 'Failed calls', value: percent(figures.failed_ratio), note: `${percent(figures.refused_ratio)} refused`,
     line: lines.failed_ratio, bad: bad('SpikeserveErrors', 'SpikeserveCallsRefused')},
    decisions,
    {label: 'Call, p99', value: si(figures.call_p99_seconds, 's'),
     note: `${si(figures.decision_p99_seconds, 's')} engine`, line: lines.call_p99_seconds,
     bad: bad('SpikeserveSlow')},
    returns,
    spikes,
    {label: 'Sessions', value: count(figures.sessions), note: `of at most ${si(figures.sessions_limit)}`,
     line: lines.sessions, bad: bad('SpikeserveSessionsNearLimit')},
    energy,
  ];
}

function versionTiles(figures, lines, model, status, route) {
  const {decisions, returns, spikes, energy} = commonTiles(figures, lines, model, status, route);
  return [
    {label: 'Errors / s', value: fixed(figures.errors_per_second), note: 'of decisions'},
    decisions,
    {label: 'Decision, p99', value: si(figures.decision_p99_seconds, 's'),
     note: `${si(figures.decision_seconds.p50, 's')} p50`, line: lines.decision_p99_seconds},
    returns,
    spikes,
    {label: 'Sessions', value: count(figures.sessions), note: '', line: lines.sessions},
    energy,
    {label: 'Head drift', value: fixed(figures.head_drift, 4),
     note: `${fixed(figures.head_updates_per_second)} updates / s, ${count(figures.held_out_sessions)} held out, ` +
       `${count(figures.trimmed_contributions)} trimmed`,
     bad: fires(status, route, 'SpikeserveLearningRolledBack')},
  ];
}

const UNUSUAL = 'SpikeserveUnusualObservations';

/** The alerts that fire, and those whose condition holds but not yet long enough. */
export class AlertList {
  constructor(target) {
    this.target = target;
    this.shown = '';
  }

  /** `robots` are the sessions with unusual observations by policy/version. */
  show(alerts, robots) {
    const active = alerts.flatMap((alert) => alert.instances.map((instance) => ({alert, ...instance})))
      .sort((a, b) => a.state.localeCompare(b.state));  // firing before pending
    const texts = active.map(({alert, labels, state}) => alert.name + JSON.stringify(labels) + state);
    if (texts.join() !== this.shown) {
      this.shown = texts.join();
      this.target.replaceChildren(...active.map(({alert, labels, state}) => this.item(alert, labels, state)));
      this.named = undefined;
    }
    active.forEach(({alert, value, seconds, state}, i) => {
      const wait = state === 'firing' ? `for ${duration(seconds)}` : `fires in ${duration(alert.for_seconds - seconds)}`;
      setText(this.target.children[i].querySelector('.quiet'), `value ${Number(value.toPrecision(3))}, ${wait}`);
    });
    const named = JSON.stringify([...robots].map(([key, list]) => [key, list.map(nameOf)]));
    if (named === this.named) return;
    this.named = named;
    active.forEach(({alert, labels}, i) => {
      const list = (alert.name === UNUSUAL && robots.get(`${labels.policy}/${labels.version}`)) || [];
      const links = list.flatMap((session, j) => [
        j ? ', ' : list.length === 1 ? 'robot ' : 'robots ',
        element('a', {href: sessionLink(session.session_id), textContent: nameOf(session)})]);
      this.target.children[i].querySelector('.robots').replaceChildren(...links);
    });
  }

  item(alert, labels, state) {
    const {policy, version, ...others} = labels;
    const rest = Object.entries(others).map(([key, value]) => ` ${key} ${value}`).join(',');
    const of = policy ? [element('a', {href: policyLink(policy, version), textContent: `${policy}/${version}`}), `${rest}: `] : [];
    // Folded where there is little room, so that the figures stay on the first screen.
    return element('li', {className: state}, element('details', {open: !matchMedia('(max-width: 40rem)').matches},
      element('summary', {}, element('strong', {textContent: alert.name}), ` (${alert.severity}) `, ...of,
              element('span', {className: 'robots'})),
      `${alert.description} `, element('span', {className: 'quiet', textContent: NOTHING})));
  }
}
