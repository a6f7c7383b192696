// Compares the versions of a policy that share its traffic: roll-outs, with the evidence that the server collects, and
// shares that an operator has set. Says in one sentence whether the newer version is worse.
import {NOTHING, count, element, fixed, percent, policyLink, si} from './format.js';
import {lossOf, stateOf} from './policies.js';

const SURE = 2;  // standard errors: a difference that chance makes in one of twenty comparisons
const SLOWER = 1.25;  // the factor that docs/guides/policies.md advises for --abort_if=p99

/** Returns {episodes, mean, deviation, failed, p99} of the evidence about one version in a roll-out. */
function ofEvidence(evidence) {
  const sessions = Number(evidence.sessions);
  const episodes = Number(evidence.episodes);
  return {
    sessions,
    episodes,
    mean: episodes > 0 ? evidence.mean_return : undefined,
    deviation: evidence.return_deviation,
    failed: sessions > 0 ? Number(evidence.failed_sessions) / sessions : undefined,
    p99: Number(evidence.decisions) > 0 ? evidence.p99_seconds : undefined,
  };
}

function ofFigures(row) {
  return {sessions: row.sessions, episodes: row.episodes, mean: row.return_mean ?? undefined,
          deviation: undefined, failed: undefined, p99: row.decision_p99_seconds ?? undefined};
}

/** Returns how much better the first version's return is, as a sentence's middle, and whether that is worse. */
function judgeReturn(fresh, stable) {
  if (fresh.mean === undefined || stable.mean === undefined) return {text: 'has too few episodes to judge its return'};
  const difference = fresh.mean - stable.mean;
  const relative = stable.mean === 0 ? '' : ` (${difference >= 0 ? '+' : '−'}${percent(Math.abs(difference / stable.mean))})`;
  const values = `${fixed(fresh.mean)} against ${fixed(stable.mean)}${relative}`;
  if (fresh.deviation === undefined) {
    const word = difference < 0 ? 'a lower' : difference > 0 ? 'a higher' : 'an equal';
    return {text: `has ${word} return: ${values}`, worse: difference < 0};
  }
  if (Math.min(fresh.episodes, stable.episodes) < 2) return {text: 'has too few episodes to judge its return'};
  const error = Math.sqrt(fresh.deviation ** 2 / fresh.episodes + stable.deviation ** 2 / stable.episodes);
  if (Math.abs(difference) <= SURE * error) return {text: `has no clearly different return: ${values}`};
  return difference < 0 ? {text: `has a worse return: ${values}`, worse: true} : {text: `has a better return: ${values}`};
}

function verdictOf(name, fresh, stable) {
  const judged = judgeReturn(fresh, stable);
  const parts = [judged.text];
  let {worse} = judged;
  if (fresh.failed > stable.failed) {
    parts.push(`fails in more sessions: ${percent(fresh.failed)} against ${percent(stable.failed)}`);
    worse = true;
  }
  if (fresh.p99 > SLOWER * stable.p99) {
    parts.push(`is slower: p99 ${si(fresh.p99, 's')} against ${si(stable.p99, 's')}`);
    worse = true;
  }
  return {text: `${name} ${parts.join(', and ')}.`, worse};
}

const COLUMNS = ['Version', 'Share', 'Sessions', 'Episodes', 'Return', 'Failed', 'p99'];

function table(rows) {
  const head = element('tr', {}, ...COLUMNS.map(
    (text, i) => element('th', {scope: 'col', textContent: text, className: i === 0 ? 'text' : ''})));
  const body = rows.map(({name, link, share, of}) => element('tr', {},
    element('td', {className: 'text'}, element('a', {href: link, textContent: name})),
    ...[share === undefined ? NOTHING : `${share} %`, count(of.sessions), count(of.episodes),
        fixed(of.mean) + (of.deviation && of.mean !== undefined ? ` ± ${fixed(of.deviation)}` : ''),
        percent(of.failed), si(of.p99, 's')].map((text, i) => {
      const cell = element('td', {textContent: text});
      cell.dataset.label = COLUMNS[i + 1];
      return cell;
    })));
  return element('div', {className: 'scroll'},
                 element('table', {className: 'figures'}, element('thead', {}, head), element('tbody', {}, ...body)));
}

/** Returns the steps of a roll-out, such as 1 % 10 % 50 % 100 %, with those that it has reached. */
function stepsOf(rollout) {
  return element('ol', {className: 'steps'}, ...rollout.steps.map((step, i) => element('li', {
    textContent: `${step} %`,
    className: i < rollout.step || stateOf(rollout) === 'completed' ? 'reached' : i === rollout.step ? 'current' : '',
  })));
}

function card(title, verdict, ...more) {
  const judged = element('p', {className: verdict.worse ? 'verdict bad' : 'verdict', textContent: verdict.text});
  return element('article', {className: 'comparison'}, element('h3', {textContent: title}), judged, ...more);
}

/** Returns what off-policy evaluation expected of the new version before the roll-out. */
function expectation(rollout) {
  const offline = rollout.offline_evaluation;
  if (!offline) return [];
  const interval = (name) => `${fixed(offline[name])} (${fixed(offline[`${name}_low`])} to ${fixed(offline[`${name}_high`])})`;
  return [element('p', {
    className: 'expectation',
    textContent: `Expected before it began: return ${interval('new_return')}, ${interval('difference')} more than ` +
      `${rollout.policy}/${rollout.stable_version}, by ${fixed(offline.effective_episodes)} effective of ${count(Number(offline.episodes))} episodes.`,
  })];
}

/** Returns what rounding cost the versions, where their files say so. */
function losses(infos) {
  const text = lossOf(infos);
  return text ? [element('p', {className: 'loss', textContent: `${text}.`})] : [];
}

function rolloutCard(rollout, infos) {
  const name = `${rollout.policy}/${rollout.version}`;
  const stable = `${rollout.policy}/${rollout.stable_version}`;
  const running = stateOf(rollout) === 'running';
  const [fresh, old] = [ofEvidence(rollout.new_version_evidence), ofEvidence(rollout.stable_version_evidence)];
  return card(`Roll-out of ${name}: ${stateOf(rollout)}`, verdictOf(name, fresh, old),
              ...losses(infos), ...expectation(rollout), stepsOf(rollout), table([
    {name, link: policyLink(rollout.policy, rollout.version), share: running ? rollout.percent : undefined, of: fresh},
    {name: stable, link: policyLink(rollout.policy, rollout.stable_version), share: running ? 100 - rollout.percent : undefined, of: old},
  ]), element('p', {className: 'quiet', textContent: rollout.reason}));
}

/** Compares versions by the figures of the window with the first one, the one with the largest share or number of decisions. */
function sharesCard(policy, versions) {
  const weight = (row) => [row.info.traffic_percent ?? 0, row.decisions ?? 0];
  const [stable, ...others] = [...versions].sort((a, b) => weight(b)[0] - weight(a)[0] || weight(b)[1] - weight(a)[1]);
  const split = versions.some(({info}) => info.traffic_percent > 0);
  const name = (row) => `${policy}/${row.info.version}`;
  const verdicts = others.map((row) => verdictOf(name(row), ofFigures(row), ofFigures(stable)));
  return card(`${split ? 'Shares' : 'Versions'} of ${policy}`,
              {text: verdicts.map(({text}) => text).join(' '), worse: verdicts.some(({worse}) => worse)},
              ...losses(versions.map(({info}) => info)),
              table([stable, ...others].map((row) => ({
                name: name(row), link: policyLink(policy, row.info.version), share: row.info.traffic_percent,
                of: ofFigures(row),
              }))),
              element('p', {className: 'quiet', textContent: 'Figures of the selected window, without a test of chance.'}));
}

export class Comparisons {
  constructor(target) {
    this.target = target;
    this.shown = '';
  }

  show(status, route) {
    const wanted = (policy) => !route.policy || policy === route.policy;
    const rollouts = status.rollouts.filter(({policy}) => wanted(policy));
    const inRollout = new Set(rollouts.filter((rollout) => stateOf(rollout) === 'running').map(({policy}) => policy));
    const shares = new Map();
    for (const info of status.policies) {
      if (inRollout.has(info.name) || !wanted(info.name)) continue;
      const figures = status.versions.find((row) => row.policy === info.name && row.version === info.version);
      // Sessions that ask for a version play it although the traffic is not split.
      if (!(info.traffic_percent > 0) && !(figures?.sessions > 0) && !(figures?.decisions_per_second > 0)) continue;
      shares.set(info.name, [...(shares.get(info.name) ?? []), {...figures, info}]);
    }
    const split = [...shares].filter(([, versions]) => versions.length > 1);
    const key = JSON.stringify([rollouts, split]);
    if (key === this.shown) return;
    this.shown = key;
    const infosOf = ({policy, version, stable_version: stable}) => status.policies.filter(
      (info) => info.name === policy && (info.version === version || info.version === stable));
    const cards = [...rollouts.map((rollout) => rolloutCard(rollout, infosOf(rollout))),
                   ...split.map(([policy, versions]) => sharesCard(policy, versions))];
    const title = cards.length ? [element('h2', {textContent: 'Roll-outs and canaries'})] : [];
    this.target.replaceChildren(...title, element('div', {}, ...cards));
  }
}
