// Plays a policy in its task, draws the task and the spikes of the decisions, and lists the episodes.
import * as engine from './engine.js';
import {drawDecision} from './explain.js';
import {count, element, fixed, setText, si} from './format.js';
import {Scene} from './scene.js';

const FRAME_MILLISECONDS = 12;  // of decisions between two pictures, as fast as the engine can
const EXPLAINING_SHARE = 0.3;  // at most this part of the time recomputes decisions for the rasters
const LISTED_EPISODES = 10;

const get = (id) => document.getElementById(id);
const scene = new Scene(get('scene'));
let episode;  // the sums of the running episode
let shown;  // the explained decision on the page
let explainAfter = 0;  // in milliseconds of performance.now()
let timer;

function playing() {
  return get('play').getAttribute('aria-pressed') === 'true';
}

function setPlaying(on) {
  get('play').setAttribute('aria-pressed', String(on));
  clearTimeout(timer);
  if (on) timer = setTimeout(turn, 0);
}

/** Runs `action`, and stops with its message if it fails. */
async function attempt(action) {
  setText(get('error'), '');
  try {
    await action();
  } catch (error) {
    setPlaying(false);
    setText(get('error'), error.message);
  }
}

async function open() {
  const chosen = get('policy').value;
  const response = await fetch(`policies/${chosen}/policy.safetensors`);
  const file = new Uint8Array(await response.arrayBuffer());
  if (get('policy').value !== chosen) return;  // another one, which may be open already
  if (!response.ok) throw new Error(`${response.url}: ${response.status} ${response.statusText}`);
  engine.open(file, get('seed').valueAsNumber || 0);
  episode = undefined;
  explainAfter = 0;
  scene.clear();
  get('episodes').replaceChildren();
  decide();
}

/** Decides `enough()` times, but at least once, and shows the last decision. */
function decide(enough = () => true) {
  let decision, milliseconds;
  do {
    const start = performance.now();
    decision = engine.step();
    milliseconds = performance.now() - start;
    record(decision);
  } while (!enough());
  show(decision, milliseconds);
}

/** Returns the energy with memory, or for a policy in float32 that of horowitz_45nm. */
function joulesOf(stats) {
  return stats.int_sram_energy_joules ?? stats.energy_joules;
}

function record({seed, answer: {stats}, episode_return, ended}) {
  if (!episode || episode.ended) episode = {seed, steps: 0, spikes: 0, joules: 0};
  episode.steps += 1;
  episode.spikes += stats.spikes;
  episode.joules += joulesOf(stats);
  episode.ended = ended;
  if (!ended) return;
  const cells = [seed, fixed(episode_return, 3), episode.steps, count(episode.spikes), si(episode.joules, 'J')];
  get('episodes').prepend(element('tr', {}, ...cells.map((textContent) => element('td', {textContent}))));
  get('episodes').children[LISTED_EPISODES]?.remove();
}

function show(decision, milliseconds) {
  const {stats, step} = decision.answer;
  scene.show(decision, decision.environment);
  const tiles = [
    ['Policy', get('policy').value, decision.mode],
    ['Return so far', fixed(decision.episode_return), `step ${step}, seed ${decision.seed}`],
    ['Spikes', count(stats.spikes), 'this decision'],
    ['Energy', si(joulesOf(stats), 'J'), 'estimate'],
    ['Time', si(milliseconds / 1000, 's'), 'in this browser'],
  ];
  get('session-tiles').replaceChildren(...tiles.map(([label, value, note]) => element('div', {},
    element('dt', {textContent: label}), element('dd', {className: 'value', textContent: value}),
    element('dd', {className: 'quiet', textContent: note}))));
  const start = performance.now();
  if (playing() && start < explainAfter) return;
  shown = engine.explain();
  const [policy, version] = get('policy').value.split('/');
  Object.assign(shown, {policy, version});
  drawShown();
  const end = performance.now();
  explainAfter = end + (end - start) / EXPLAINING_SHARE;
}

function drawShown() {
  if (shown) drawDecision(get('decision'), shown, get('token').value);
}

function turn() {
  const speed = Number(get('speed').value);
  const end = performance.now() + FRAME_MILLISECONDS;
  attempt(() => {
    decide(speed ? undefined : () => performance.now() >= end);
    if (playing()) timer = setTimeout(turn, speed ? 1000 / speed : 0);
  });
}

const policies = await (await fetch('policies.json')).json();
get('policy').replaceChildren(...policies.map((policy) => element('option', {textContent: policy, value: policy})));
for (const id of ['policy', 'seed']) get(id).addEventListener('change', () => attempt(open));
get('restart').addEventListener('click', () => attempt(open));
get('token').addEventListener('change', drawShown);
get('play').addEventListener('click', () => setPlaying(!playing()));
get('step').addEventListener('click', () => {
  setPlaying(false);
  attempt(() => decide());
});
await attempt(open);
setPlaying(playing());
