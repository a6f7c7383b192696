// Fetches the status of the server once a second and passes it to the parts of the page.
import {Charts} from './charts.js';
import {Explanation} from './explain.js';
import {Policies} from './policies.js';
import {Samples} from './samples.js';
import {Sessions} from './sessions.js';

const PERIOD_MILLISECONDS = 1000;

const samples = new Samples();
const policies = new Policies();
const charts = new Charts();
const explanation = new Explanation();
const sessions = new Sessions((id) => {
  sessions.mark(id);
  explanation.show(id).catch(showProblem);
});

const health = document.getElementById('health');
const pause = document.getElementById('pause');
const windowChoice = document.getElementById('window');
const energyModel = document.getElementById('energy-model');

function showProblem(error) {
  setHealth(`no answer from the server: ${error.message}`, false);
}

function setHealth(text, good) {
  // Written only when it changes, so that a screen reader does not repeat it every second.
  if (health.textContent !== text) health.textContent = text;
  health.classList.toggle('bad', !good);
}

function draw() {
  if (!samples.latest) return;
  policies.show(samples.window(Number(windowChoice.value)), energyModel.value);
  charts.show(samples, energyModel.value);
}

async function update() {
  const response = await fetch('status.json');
  if (!response.ok) throw new Error((await response.json()).message);
  const status = await response.json();
  samples.add(status);
  document.getElementById('version').textContent = status.version;
  setHealth(status.serving ? 'serving' : 'not serving (draining)', status.serving);
  draw();
  await sessions.refresh();
}

async function run() {
  const paused = pause.getAttribute('aria-pressed') === 'true';
  if (!paused && !document.hidden) await update().catch(showProblem);
  setTimeout(run, PERIOD_MILLISECONDS);
}

pause.addEventListener('click', () => {
  pause.setAttribute('aria-pressed', String(pause.getAttribute('aria-pressed') !== 'true'));
});
windowChoice.addEventListener('change', draw);
energyModel.addEventListener('change', draw);
run();
