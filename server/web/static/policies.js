// The tables of policies, returns, stages and calls, the totals, and the policy that uses the most energy.
import {NOTHING, count, fixed, isNumber, seconds, si} from './format.js';
import {quantile} from './samples.js';
import {Table} from './table.js';

export const STAGES = ['coder', 'phase', 'query', 'key', 'value', 'ffn_in', 'ffn_hidden', 'readout'];
const JOULES_PER_SPIKE = 5e-12;  // of energy model spike_5pj, the only one that is counted by stage
const QUANTILES = [['p50', 0.5], ['p90', 0.9], ['p99', 0.99], ['p99.9', 0.999]];

/** Returns one row for each policy version with its figures over a window. */
export function policyRows(window, energyModel) {
  const rollouts = new Map(window.to.status.rollouts.map((rollout) => [`${rollout.policy}/${rollout.version}`, rollout]));
  const rows = window.to.status.policies.map((policy) => policyRow(policy, window, energyModel, rollouts));
  const power = rows.reduce((sum, row) => sum + (row.power || 0), 0);
  for (const row of rows) row.powerShare = power > 0 ? row.power / power : 0;
  return rows;
}

/** Returns the state of a roll-out, such as running. */
function stateOf(rollout) {
  return rollout.state.replace('STATE_', '').toLowerCase();
}

/** Returns the share of the new sessions that a version gets, its labels, whether it is the shadow, and its roll-out. */
function trafficText(policy, rollout) {
  const parts = [];
  if (policy.traffic_percent !== undefined) parts.push(`${policy.traffic_percent} %`);
  else if (policy.is_default) parts.push('100 %');
  parts.push(...policy.version_labels);
  if (policy.is_shadow) parts.push('(shadow)');
  if (rollout) parts.push(`(roll-out ${stateOf(rollout)})`);
  return parts.join(' ') || NOTHING;
}

function policyRow(policy, window, energyModel, rollouts) {
  const labels = {policy: policy.name, version: policy.version};
  const withModel = {...labels, energy_model: energyModel};
  // A policy to which the model does not apply has no series under it, and so no figure.
  const priced = window.matching('spikeserve_energy_joules_total', withModel).length > 0;
  const decisions = window.increase('spikeserve_decisions_total', labels);
  const perDecision = (x) => (decisions > 0 ? x / decisions : undefined);
  const durations = window.histogram('spikeserve_decision_duration_seconds', labels);
  const row = {
    key: `${policy.name}/${policy.version}`,
    name: policy.name,
    version: Number(policy.version),
    mode: policy.mode,
    environment: policy.environment,
    isDefault: policy.is_default,
    traffic: trafficText(policy, rollouts.get(`${policy.name}/${policy.version}`)),
    sessions: window.gauge('spikeserve_sessions', labels) ?? 0,
    decisionRate: window.rate('spikeserve_decisions_total', labels),
    spikes: perDecision(window.increase('spikeserve_spikes_total', labels)),
    energy: priced ? perDecision(window.increase('spikeserve_energy_joules_total', withModel)) : undefined,
    power: priced ? window.rate('spikeserve_energy_joules_total', withModel) : undefined,
    energyTotal: window.gauge('spikeserve_energy_joules_total', withModel),
    episodes: window.gauge('spikeserve_episodes_total', labels) ?? 0,
    drift: window.gauge('spikeserve_head_drift_ratio', labels),
    updates: window.rate('spikeserve_learning_updates_total', labels),
    stages: Object.fromEntries(STAGES.map(
      (stage) => [stage, perDecision(window.increase('spikeserve_spikes_total', {...labels, stage}))])),
  };
  row.meanReturn = row.episodes > 0 ? window.gauge('spikeserve_episode_return_mean', labels) : undefined;
  for (const [name, q] of QUANTILES) row[name] = quantile(durations, q);
  return row;
}

function numberColumn(key, label, format) {
  return {key, label, value: (row) => row[key], text: (row) => format(row[key])};
}

const quantileColumns = QUANTILES.map(([name]) => numberColumn(name, name, seconds));

export class Policies {
  constructor() {
    const name = {key: 'key', label: 'Policy', value: (row) => row.key, text: (row) => row.key, isText: true};
    const key = (row) => row.key;
    this.table = new Table(document.getElementById('policies-table'), [
      name,
      {key: 'power', label: 'Energy per second (estimate)', value: (row) => row.power,
       text: (row) => si(row.power, 'J/s'), share: (row) => row.powerShare},
      numberColumn('energy', 'Energy per decision (estimate)', (x) => si(x, 'J')),
      numberColumn('energyTotal', 'Energy since start (estimate)', (x) => si(x, 'J')),
      numberColumn('spikes', 'Spikes per decision', fixed),
      numberColumn('decisionRate', 'Decisions per second', fixed),
      numberColumn('sessions', 'Sessions', count),
      ...quantileColumns,
    ], {sort: 'power', descending: true, key});
    this.returns = new Table(document.getElementById('returns-table'), [
      name,
      {key: 'environment', label: 'Environment', value: (row) => row.environment, isText: true,
       text: (row) => `${row.environment} ${row.mode}${row.isDefault ? ' (default)' : ''}`},
      {key: 'traffic', label: 'New sessions', value: (row) => row.traffic, text: (row) => row.traffic, isText: true},
      numberColumn('meanReturn', 'Mean return since start', fixed),
      numberColumn('episodes', 'Episodes since start', count),
      numberColumn('drift', 'Head drift', (x) => fixed(x, 4)),
      numberColumn('updates', 'Head updates per second', fixed),
    ], {sort: 'episodes', descending: true, key});
    this.rollouts = new Table(document.getElementById('rollouts-table'), [
      {key: 'key', label: 'Roll-out', value: (row) => row.key, text: (row) => row.key, isText: true},
      {key: 'state', label: 'State', value: (row) => row.state, text: (row) => row.state, isText: true},
      numberColumn('percent', 'Reached, %', count),
      numberColumn('episodes', 'Episodes', count),
      numberColumn('meanReturn', 'Mean return', fixed),
      numberColumn('stableReturn', 'Mean return, stable', fixed),
      numberColumn('failed', 'Sessions with errors', count),
      numberColumn('p99', 'p99', seconds),
      numberColumn('stableP99', 'p99, stable', seconds),
      {key: 'reason', label: 'Why', value: (row) => row.reason, text: (row) => row.reason, isText: true},
    ], {sort: 'key', key});
    const unit = document.getElementById('stage-unit');
    const stageText = (spikes) => (unit.value === 'spikes' ? fixed(spikes) : si(spikes * JOULES_PER_SPIKE, 'J'));
    unit.addEventListener('change', () => this.stages.show(this.stages.rows));
    this.stages = new Table(document.getElementById('stages-table'), [
      name,
      ...STAGES.map((stage) => ({
        key: stage, label: stage, value: (row) => row.stages[stage], text: (row) => stageText(row.stages[stage]),
        share: (row) => row.stages[stage] / row.spikes,
      })),
      numberColumn('spikes', 'all', stageText),
    ], {sort: 'spikes', descending: true, key});
    this.calls = new Table(document.getElementById('calls-table'), [
      {key: 'method', label: 'Method', value: (row) => row.method, text: (row) => row.method, isText: true},
      numberColumn('rate', 'Calls per second', fixed),
      numberColumn('failures', 'Failed calls per second', fixed),
      ...quantileColumns,
    ], {sort: 'rate', descending: true, key: (row) => row.method});
  }

  show(window, energyModel) {
    const rows = policyRows(window, energyModel);
    this.table.show(rows);
    this.returns.show(rows);
    this.stages.show(rows);
    this.calls.show(callRows(window));
    const rollouts = window.to.status.rollouts;
    document.getElementById('rollouts').hidden = rollouts.length === 0;
    this.rollouts.show(rollouts.map(rolloutRow));
    showTotals(rows, window);
    showMostEnergy(rows, energyModel);
  }
}

function rolloutRow(rollout) {
  const fresh = rollout.new_version_evidence;
  const stable = rollout.stable_version_evidence;
  const measured = (evidence) => (Number(evidence.decisions) > 0 ? evidence.p99_seconds : undefined);
  const returned = (evidence) => (Number(evidence.episodes) > 0 ? evidence.mean_return : undefined);
  return {
    key: `${rollout.policy}/${rollout.version}`,
    state: stateOf(rollout),
    percent: rollout.percent,
    episodes: Number(fresh.episodes),
    meanReturn: returned(fresh),
    stableReturn: returned(stable),
    failed: Number(fresh.failed_sessions),
    p99: measured(fresh),
    stableP99: measured(stable),
    reason: rollout.reason,
  };
}

function callRows(window) {
  const name = 'spikeserve_rpc_duration_seconds';
  const methods = new Set(window.matching(name).map(([, series]) => series.labels.method));
  return [...methods].map((method) => {
    const histogram = window.histogram(name, {method});
    const answered = window.histogram(name, {method, code: 'OK'}).count;
    const row = {
      method,
      rate: window.duration && histogram.count / window.duration,
      failures: window.duration && (histogram.count - answered) / window.duration,
    };
    for (const [label, q] of QUANTILES) row[label] = quantile(histogram, q);
    return row;
  });
}

function showTotals(rows, window) {
  const sum = (key) => rows.reduce((total, row) => total + (row[key] || 0), 0);
  const durations = window.histogram('spikeserve_decision_duration_seconds');
  const timed = window.duration !== undefined;
  const totals = [
    ['Sessions', count(sum('sessions'))],
    ['Decisions per second', timed ? fixed(sum('decisionRate')) : NOTHING],
    ['Decision time, p50', seconds(quantile(durations, 0.5))],
    ['Decision time, p99', seconds(quantile(durations, 0.99))],
    ['Energy per second (estimate)', timed ? si(sum('power'), 'J/s') : NOTHING],
  ];
  document.getElementById('totals').replaceChildren(...totals.map(([label, value]) => {
    const item = document.createElement('div');
    item.append(Object.assign(document.createElement('dt'), {textContent: label}),
                Object.assign(document.createElement('dd'), {textContent: value}));
    return item;
  }));
}

function showMostEnergy(rows, energyModel) {
  const line = document.getElementById('most-energy');
  const running = rows.filter((row) => row.power > 0);
  const top = (list, key) => list.reduce((best, row) => (row[key] > (best?.[key] ?? 0) ? row : best), undefined);
  const most = top(running, 'power') ?? top(rows, 'energyTotal');
  if (!most) {
    line.textContent = 'No policy has used energy yet.';
    return;
  }
  const figure = isNumber(most.power) && most.power > 0
    ? `${si(most.power, 'J/s')}, ${fixed(100 * most.powerShare, 0)} % of the total`
    : `${si(most.energyTotal, 'J')} since the server started, none in this window`;
  line.replaceChildren('Most energy: ', Object.assign(document.createElement('strong'), {textContent: most.key}),
                       ` (${figure}; estimated by ${energyModel}).`);
}
