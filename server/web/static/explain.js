// Shows one decision: spike rasters by layer and stage, phase spikes, routing gates and attention.
import {count, fixed, si} from './format.js';
import {STAGES} from './policies.js';

const RASTER_WIDTH = 165;  // pixels, so that the six rasters of a layer fit in one row
const SYMBOLS = {RETURN_TO_GO: 'G', STATE: 's', ACTION: 'a'};

function tokenName(token) {
  return `${SYMBOLS[token.kind]} ${token.timestep}`;
}

function element(tag, properties, ...children) {
  const made = Object.assign(document.createElement(tag), properties);
  made.append(...children);
  return made;
}

function section(title, figures) {
  return [element('h3', {textContent: title}), element('div', {className: 'rasters'}, ...figures)];
}

export class Explanation {
  constructor() {
    this.section = document.getElementById('decision');
    this.body = document.getElementById('decision-body');
    this.error = document.getElementById('decision-error');
    this.token = document.getElementById('token');
    this.token.addEventListener('change', () => this.draw());
    document.getElementById('explain-again').addEventListener('click', () => this.load(this.session));
    matchMedia('(prefers-color-scheme: dark)').addEventListener('change', () => this.draw());
  }

  /** Loads and shows the last decision of a session, and moves the keyboard focus to it. */
  async show(session) {
    this.section.hidden = false;
    await this.load(session);
    this.section.focus();
    this.section.scrollIntoView();
  }

  async load(session) {
    this.session = session;
    const response = await fetch(`explain.json?${new URLSearchParams({session})}`);
    const answer = await response.json();
    if (this.session !== session) return;
    this.decision = response.ok ? answer : undefined;
    this.error.textContent = response.ok ? '' : answer.message;
    this.draw();
  }

  draw() {
    const decision = this.decision;
    if (!decision) {
      this.body.replaceChildren();
      return;
    }
    this.body.replaceChildren(summary(decision), ...this.rasters(decision), ...routing(decision),
                              ...attention(decision));
  }

  rasters(decision) {
    if (decision.rasters.length === 0) {
      return [element('p', {textContent: 'A dense policy has no spikes.'})];
    }
    const wanted = decision.rasters.filter((raster) => !this.token.value || raster.token.kind === this.token.value);
    const layers = [...new Set(wanted.map((raster) => raster.layer))].sort((a, b) => (a ?? 1e9) - (b ?? 1e9));
    return layers.flatMap((layer) => {
      const figures = STAGES.flatMap((stage) => {
        const rasters = wanted.filter((raster) => raster.layer === layer && raster.stage === stage);
        return rasters.length ? [rasterFigure(stage, rasters, decision.ticks)] : [];
      });
      const title = layer === undefined ? 'Spikes outside the layers' : `Spikes of layer ${layer}`;
      return section(title, figures);
    });
  }
}

function summary(decision) {
  const {answer} = decision;
  const action = answer.action.continuous ? answer.action.continuous.values.map((x) => fixed(x, 3)).join(', ')
                                          : answer.action.discrete;
  const list = (numbers) => numbers.map((x) => fixed(x, 3)).join(', ');
  const facts = [
    ['Session', decision.session_id], ['Policy', `${decision.policy}/${decision.version} (${decision.mode})`],
    ['Episode and step', `${decision.episode}, ${answer.step}`], ['Observation', list(decision.observation)],
    ['Return-to-go', fixed(answer.return_to_go, 2)], ['Action', action],
    ['Probabilities', list(answer.action_probabilities) || 'none (continuous action)'],
    ['Logits', list(decision.logits)], ['Spikes', count(Number(answer.stats.spikes))],
    ['Membrane updates', count(Number(answer.stats.membrane_updates))],
    ['Energy (estimate)', `${si(answer.stats.energy_joules, 'J')} by horowitz_45nm`],
  ];
  const body = element('tbody', {});
  for (const [name, value] of facts) {
    const row = body.insertRow();
    row.append(element('th', {scope: 'row', className: 'text', textContent: name}),
               element('td', {className: 'text', textContent: value}));
  }
  return element('table', {className: 'figures facts'}, body);
}

/**
 * Returns a canvas of `rows` x `columns` cells of `cell` = [width, height] pixels. `shade(row, column)` in [0, 1] is
 * the opacity of a cell. Draws a vertical line before each column in `lines`. `description` is the text for screen
 * readers.
 */
function heatMap(rows, columns, cell, shade, lines, description) {
  const canvas = element('canvas', {className: 'map', width: columns * cell[0], height: rows * cell[1]});
  canvas.setAttribute('role', 'img');
  canvas.setAttribute('aria-label', description);
  const style = getComputedStyle(document.documentElement);
  const context = canvas.getContext('2d');
  context.fillStyle = style.getPropertyValue('--ground');
  context.fillRect(0, 0, canvas.width, canvas.height);
  context.fillStyle = style.getPropertyValue('--spike');
  for (let row = 0; row < rows; ++row) {
    for (let column = 0; column < columns; ++column) {
      context.globalAlpha = shade(row, column);
      if (context.globalAlpha > 0) context.fillRect(column * cell[0], row * cell[1], cell[0], cell[1]);
    }
  }
  context.globalAlpha = 1;
  context.fillStyle = style.getPropertyValue('--line');
  for (const column of lines) context.fillRect(column * cell[0], 0, 1, canvas.height);
  return canvas;
}

function figure(title, canvas, axis) {
  return element('figure', {}, element('figcaption', {textContent: title}), canvas,
                 element('p', {className: 'axis', textContent: axis}));
}

/** Draws the spikes of one stage: one row per neuron, one column per tick, the tokens side by side. */
function rasterFigure(stage, rasters, ticks) {
  const fired = new Set();
  let spikes = 0;
  rasters.forEach((raster, i) => raster.ticks.forEach((tick, j) => {
    fired.add(`${raster.neurons[j]} ${i * ticks + tick}`);
    ++spikes;
  }));
  const population = rasters[0].population;
  const names = rasters.map((raster) => tokenName(raster.token)).join(' | ');
  const columns = rasters.length * ticks;
  const width = Math.max(4, Math.floor(RASTER_WIDTH / columns));
  const height = population <= 16 ? 12 : population <= 160 ? 2 : 1;
  const title = `${stage}: ${spikes} spike${spikes === 1 ? '' : 's'}`;
  const canvas = heatMap(population, columns, [width, height],
                         (neuron, column) => (fired.has(`${neuron} ${column}`) ? 1 : 0),
                         rasters.map((_, i) => i * ticks),
                         `${title} of ${population} neurons over ${ticks} ticks of ${names}`);
  const axis = `${population} neurons ↓, ${ticks} ticks → of ${names}`;
  return figure(title, canvas, axis);
}

function routing(decision) {
  if (decision.routing.length === 0) return [];
  const {heads, ticks} = decision;
  const figures = decision.routing.map(({layer, tokens, gates}) => {
    const columns = tokens.length * ticks;
    const largest = Math.max(...gates);
    const canvas = heatMap(heads, columns, [Math.max(1, Math.min(14, Math.floor(900 / columns))), 14],
                           (head, column) => gates[column * heads + head] / largest,
                           tokens.map((_, i) => i * ticks),
                           `routing gates of layer ${layer}, ${heads} heads over the ticks of ${tokens.length} tokens`);
    const last = gates.slice(-ticks * heads);
    const means = Array.from({length: heads}, (_, head) =>
      last.filter((__, i) => i % heads === head).reduce((sum, gate) => sum + gate, 0) / ticks);
    return figure(`Layer ${layer}`, canvas, `${heads} heads ↓, ticks → of ${tokenName(tokens[0])} to ` +
      `${tokenName(tokens[tokens.length - 1])}; means for the last token: ` +
      means.map((x) => fixed(x, 2)).join(', '));
  });
  return section('Routing gates', figures);
}

function attention(decision) {
  const {heads} = decision;
  const figures = decision.attention.map(({layer, ticks, keys, weights}) => {
    const n = keys.length;
    // Rows: all ticks of the first head, then all ticks of the second, and so on.
    const weight = (row, key) => weights[((row % ticks) * heads + Math.floor(row / ticks)) * n + key];
    const rows = heads * ticks;
    const largest = Math.max(...weights);
    const canvas = heatMap(rows, n,
                           [Math.max(2, Math.min(14, Math.floor(700 / n))), Math.max(4, Math.floor(160 / rows))],
                           (row, key) => weight(row, key) / largest,
                           keys.flatMap((key, i) => (key.kind === 'RETURN_TO_GO' ? [i] : [])),
                           `attention of layer ${layer}, ${rows} rows of heads and ticks over ${n} keys`);
    return figure(`Layer ${layer}`, canvas, `${heads} heads of ${ticks} ticks ↓, keys → ${tokenName(keys[0])} to ` +
      `${tokenName(keys[n - 1])}; full colour: ${fixed(largest, 3)}`);
  });
  return section('Attention of the state token', figures);
}
