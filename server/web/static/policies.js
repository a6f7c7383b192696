// The tables of policies, of spikes by stage and of calls.
import {STAGES} from './explain.js';
import {NOTHING, count, element, fixed, isNumber, percent, policyLink, setText, si} from './format.js';
import {Table} from './table.js';

const JOULES_PER_SPIKE = 5e-12;  // of energy model spike_5pj, the only one that is counted by stage

/** Returns the state of a roll-out, such as running. */
export function stateOf(rollout) {
  return rollout.state.replace('STATE_', '').toLowerCase();
}

/** Returns one row for each policy version: its figures, what it is, and how much traffic it gets. */
export function policyRows(status, model) {
  const keyOf = (policy, version) => `${policy}/${version}`;
  const figures = new Map(status.versions.map((row) => [keyOf(row.policy, row.version), row]));
  const rollouts = new Map(status.rollouts.map((rollout) => [keyOf(rollout.policy, rollout.version), rollout]));
  const rows = status.policies.map((policy) => {
    const key = keyOf(policy.name, policy.version);
    const row = {...figures.get(key), key, info: policy, rollout: rollouts.get(key)};
    row.power = row.energy_joules_per_second?.[model];
    row.energy = row.energy_joules_per_decision?.[model];
    row.dense = row.dense_energy_joules_per_decision?.[model];
    row.chips = chipsOf(policy, row.rollout);
    row.idle = !(row.decisions > 0) && !(row.sessions > 0) && !(row.rollout && stateOf(row.rollout) === 'running');
    return row;
  });
  const power = rows.reduce((sum, row) => sum + (row.power || 0), 0);
  for (const row of rows) row.powerShare = power > 0 ? row.power / power : 0;
  return rows;
}

/** Returns what rounding cost the versions whose files say so, as text. */
export function lossOf(infos) {
  return infos.filter((info) => isNumber(info.rounding_loss))
    .map(({name, version, rounding_loss: loss}) => `${name}/${version} lost ${percent(loss)} by rounding`)
    .join(', ');
}

/** Returns which new sessions a version gets, its labels, whether it is the shadow, and its roll-out. */
function chipsOf(policy, rollout) {
  const chips = [];
  if (policy.traffic_percent !== undefined) chips.push(`${policy.traffic_percent} %`);
  else if (policy.is_default) chips.push('default');
  chips.push(...policy.version_labels);
  if (policy.is_shadow) chips.push('shadow');
  if (rollout) chips.push(`roll-out ${stateOf(rollout)}`);
  return chips;
}

function numberColumn(key, label, format, value = (row) => row[key]) {
  return {key, label, value, text: (row) => format(value(row))};
}

export class Policies {
  constructor() {
    const key = (row) => row.key;
    const name = {key: 'key', label: 'Policy', value: key, isText: true, fill: (cell, row) => {
      cell.append(element('a', {href: policyLink(row.info.name, row.info.version), textContent: row.key,
                                title: [row.info.environment, row.info.mode, lossOf([row.info])].filter(Boolean).join(', ')}));
    }};
    this.table = new Table(document.getElementById('policies-table'), [
      name,
      {key: 'chips', label: 'New sessions', isText: true, text: (row) => row.chips.join('\n') || NOTHING, update: (cell, row) => {
        cell.replaceChildren(...row.chips.map((chip) => element('span', {className: 'chip', textContent: chip})));
      }},
      {key: 'power', label: 'Energy per second', value: (row) => row.power, text: (row) => si(row.power, 'J'),
       share: (row) => row.powerShare},
      {key: 'energy', label: 'Energy per decision', value: (row) => row.energy, text: (row) => si(row.energy, 'J'),
       share: (row) => Math.min(row.energy / row.dense, 1), update: (cell, row) => {
        setText(cell, si(row.energy, 'J'));
        cell.title = `dense baseline: ${si(row.dense, 'J')}`;
      }},
      numberColumn('spikes_per_decision', 'Spikes per decision', fixed),
      numberColumn('decisions_per_second', 'Decisions per second', fixed),
      numberColumn('p50', 'p50', (x) => si(x, 's'), (row) => row.decision_seconds?.p50),
      numberColumn('p99', 'p99', (x) => si(x, 's'), (row) => row.decision_seconds?.p99),
      numberColumn('return_mean', 'Return', fixed),
      numberColumn('episodes', 'Episodes', count),
      numberColumn('errors_per_second', 'Errors per second', fixed),
      numberColumn('head_drift', 'Head drift', (x) => fixed(x, 4)),
      numberColumn('sessions', 'Sessions', count),
    ], {sort: 'power', descending: true, key});
    this.idle = document.getElementById('idle');
    this.idle.addEventListener('click', () => {
      this.idle.setAttribute('aria-expanded', String(this.idle.getAttribute('aria-expanded') !== 'true'));
      if (this.shown) this.show(...this.shown);
    });
    const unit = document.getElementById('stage-unit');
    const stageText = (spikes) => (unit.value === 'spikes' ? fixed(spikes) : si(spikes * JOULES_PER_SPIKE, 'J'));
    unit.addEventListener('change', () => this.stages.show(this.stages.rows));
    this.stages = new Table(document.getElementById('stages-table'), [
      name,
      ...STAGES.map((stage) => ({
        key: stage, label: stage, value: (row) => row.spikes_by_stage?.[stage],
        text: (row) => stageText(row.spikes_by_stage?.[stage]),
        share: (row) => row.spikes_by_stage?.[stage] / row.spikes_per_decision,
      })),
      numberColumn('spikes_per_decision', 'all', stageText),
    ], {sort: 'spikes_per_decision', descending: true, key});
    const errors = (row) => Object.values(row.errors_per_second).reduce((sum, x) => sum + (x ?? 0), 0);
    this.calls = new Table(document.getElementById('calls-table'), [
      {key: 'method', label: 'Method', value: (row) => row.method, text: (row) => row.method, isText: true},
      numberColumn('rate', 'Calls per second', fixed, (row) => row.calls_per_second),
      numberColumn('errors', 'Errors per second', fixed, errors),
      {key: 'codes', label: 'Codes', isText: true, text: (row) => Object.entries(row.errors_per_second)
        .filter(([, rate]) => rate > 0).map(([code]) => code).join(', ') || NOTHING},
      ...['p50', 'p90', 'p99', 'p999'].map((q) => numberColumn(q, q, (x) => si(x, 's'), (row) => row.seconds[q])),
    ], {sort: 'rate', descending: true, key: (row) => row.method});
  }

  show(status, route, model) {
    this.shown = [status, route, model];
    const all = policyRows(status, model);
    const rows = all.filter((row) => !route.policy || row.info.name === route.policy);
    const idle = route.policy ? [] : rows.filter((row) => row.idle);
    const open = this.idle.getAttribute('aria-expanded') === 'true';
    this.table.show(open ? rows : rows.filter((row) => !idle.includes(row)));
    this.idle.hidden = idle.length === 0;
    setText(this.idle, `${open ? 'Hide' : 'Show'} ${idle.length} idle version${idle.length === 1 ? '' : 's'}`);
    this.stages.show(rows.filter((row) => row.decisions > 0));
    this.calls.show(status.calls.filter((row) => row.calls_per_second > 0));
    this.showMostEnergy(all, route, model);
  }

  showMostEnergy(rows, route, model) {
    const line = document.getElementById('most-energy');
    line.hidden = Boolean(route.policy);
    const most = rows.reduce((best, row) => (row.power > (best?.power ?? 0) ? row : best), undefined);
    if (!most) {
      setText(line, 'No policy uses energy in this window.');
      return;
    }
    const share = isNumber(most.powerShare) ? `, ${fixed(100 * most.powerShare, 0)} % of the total` : '';
    const text = ` (${si(most.power, 'J')} per second${share}; estimated by ${model}).`;
    if (line.textContent === `Most energy: ${most.key}${text}`) return;
    line.replaceChildren('Most energy: ', element('strong', {textContent: most.key}), text);
  }
}
