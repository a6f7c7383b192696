// Fetches the state of the server and passes it to the parts of the page, which the fragment of the address selects:
//   #/                        everything
//   #/policies/NAME/VERSION   one policy version
//   #/sessions/ID             one session
import {Charts} from './charts.js';
import {Comparisons} from './comparisons.js';
import {fetchJson} from './fetch.js';
import {element, healthOf, isNumber, nameOf, sessionLink, setText} from './format.js';
import {Policies} from './policies.js';
import {Servers} from './servers.js';
import {SessionView} from './session.js';
import {Sessions} from './sessions.js';
import {AlertList, Tiles} from './tiles.js';
import {Usage} from './usage.js';

const PERIOD_MILLISECONDS = 1000;
const HISTORY_EVERY = 5;  // periods
const USAGE_EVERY = 30;
const SESSIONS_EVERY = 3;  // a list costs the server one pass over all sessions
const NAMED_ROBOTS = 8;
const LOST_SECONDS = 60;  // SpikeserveDown waits as long

const get = (id) => document.getElementById(id);
const tiles = new Tiles(get('tiles'));
const alerts = new AlertList(get('alerts'));
const charts = new Charts(get('charts'), get('chart-legend'));
const policies = new Policies();
const comparisons = new Comparisons(get('comparisons'));
const servers = new Servers();
const sessions = new Sessions();
const session = new SessionView();
const usage = new Usage();

const state = {status: undefined, history: undefined, answered: Date.now(), route: {}};

/** Returns what the fragment selects: {}, {policy, version} or {session}. */
function parseRoute() {
  const [kind, name, version] = location.hash.replace(/^#\//, '').split('/').map(decodeURIComponent);
  if (kind === 'policies' && name && version) return {policy: name, version};
  if (kind === 'sessions' && name) return {session: name};
  return {};
}

function navigate() {
  if (location.hash && !location.hash.startsWith('#/')) return;  // a place on this page
  const route = parseRoute();
  state.route = route;
  const scope = get('scope');
  const place = route.session ? ['Session ', element('code', {textContent: route.session})]
                              : [`${route.policy}/${route.version}`];
  scope.replaceChildren(element('a', {href: '#/', textContent: 'All policies'}), ' › ', ...place);
  scope.hidden = !route.session && !route.policy;
  for (const id of ['overview', 'policies', 'comparisons', 'usage', 'sessions', 'stages', 'calls']) {
    get(id).hidden = Boolean(route.session) || (['usage', 'calls'].includes(id) && Boolean(route.policy));
  }
  get('session').hidden = !route.session;
  sessions.setScope(route.policy ? `${route.policy}/${route.version}` : '');
  session.open(route.session);
  draw();
  if (!route.session) sessions.refresh().catch(showProblem);
  scrollTo(0, 0);
}

function draw() {
  const {status, history, route} = state;
  if (!status) return;
  const model = get('energy-model').value;
  alerts.show(status.alerts, robots);
  showRobots();
  tiles.show(status, history, route, model);
  if (history) charts.show(history, route, model);
  policies.show(status, route, model);
  comparisons.show(status, route);
  servers.show(status, route);
  usage.show(model);
}

function setHealth(text, good) {
  setText(get('health'), text);
  get('health').classList.toggle('bad', !good);
  document.title = good ? 'spikeserve' : `spikeserve: ${text}`;
}

function showProblem(error) {
  const seconds = Math.round((Date.now() - state.answered) / 1000);
  setHealth(`no answer for ${seconds} s: ${error.message}`, false);
  document.body.classList.toggle('lost', seconds >= LOST_SECONDS);
}

/** Chooses the first energy model, that with memory, or the first that has a figure, until somebody chooses. */
function chooseModel({energy_models: models, versions}) {
  const choice = get('energy-model');
  if (choice.dataset.chosen) return;
  const hasFigure = ({name}) => versions.some((row) => isNumber(row.energy_joules_per_decision?.[name]));
  choice.value = (models.find(hasFigure) ?? models[0]).name;
}

/** Offers the energy models that the server knows, and shows what each of them counts. */
function showModels(models) {
  const choice = get('energy-model');
  if (models.length === choice.options.length) return;
  choice.replaceChildren(...models.map(({name}) => element('option', {value: name, textContent: name})));
  get('models').replaceChildren(...models.flatMap((model) => [
    element('dt', {textContent: model.name}),
    element('dd', {textContent: `Counts ${model.counts}. Leaves out ${model.leaves_out}. Applies to ${model.applies_to}.`}),
  ]));
}

const robots = new Map();  // sessions with unusual observations, by policy/version

/** Finds the robots whose last observation was unusual. A version keeps its robots between two of their episodes. */
async function findRobots({figures}) {
  if (!(figures.unusual_per_decision > 0)) {
    robots.clear();
    return;
  }
  const {sessions: found} = await fetchJson('sessions.json', {
    sort: 'unusual_observations', order: 'descending', page_size: NAMED_ROBOTS});
  const unusual = found.filter((row) => row.unusual_observations > 0);
  for (const version of new Set(unusual.map((row) => `${row.policy}/${row.version}`))) {
    robots.set(version, unusual.filter((row) => `${row.policy}/${row.version}` === version));
  }
}

/** Names the robots, also when they are too few among many for an alert. */
function showRobots() {
  const names = [...robots.values()].flat();
  const line = get('unusual');
  line.hidden = names.length === 0;
  const key = names.map(({session_id: id}) => id).join();
  if (line.dataset.shown === key) return;
  line.dataset.shown = key;
  line.replaceChildren('Observations unlike training now: ', ...names.flatMap((row, i) => [
    i ? ', ' : '', element('a', {href: sessionLink(row.session_id), textContent: nameOf(row)})]));
}

async function update(turn) {
  const status = await fetchJson('status.json', {window: get('window').value, metrics: false});
  if (turn % HISTORY_EVERY === 0 || !state.history) state.history = await fetchJson('history.json');
  if (turn % SESSIONS_EVERY === 0) await findRobots(status);
  state.status = status;
  state.answered = Date.now();
  document.body.classList.remove('lost');
  showModels(status.energy_models);
  chooseModel(status);
  const store = status.replica ? ` · ${status.replica}, one of ${status.replicas} on ${status.store}` : '';
  setText(get('version'), status.version + store);
  const health = healthOf(status);
  setHealth(`${health.word}: ${health.alerts}`, health.good);
  if (turn % USAGE_EVERY === 0 && !state.route.session) await usage.refresh();
  draw();
  if (state.route.session) await session.refresh();
  else if (turn % SESSIONS_EVERY === 0) await sessions.refresh();
}

let turn = 0;
async function run() {
  const paused = get('pause').getAttribute('aria-pressed') === 'true';
  if (!paused && !document.hidden) await update(turn++).catch(showProblem);
  setTimeout(run, PERIOD_MILLISECONDS);
}

get('pause').addEventListener('click', ({target}) => {
  target.setAttribute('aria-pressed', String(target.getAttribute('aria-pressed') !== 'true'));
});
get('window').addEventListener('change', () => update(turn++).catch(showProblem));
get('energy-model').addEventListener('change', ({target}) => {
  target.dataset.chosen = true;
  draw();
});
addEventListener('hashchange', navigate);
matchMedia('(prefers-color-scheme: dark)').addEventListener('change', draw);
navigate();
run();
