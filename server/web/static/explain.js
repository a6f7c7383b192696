// Draws one decision: what it decided and from what, the spikes by layer and stage, routing gates and attention.
import {count, element, fixed, isNumber, si} from './format.js';

export const STAGES = ['coder', 'phase', 'query', 'key', 'value', 'ffn_in', 'ffn_hidden', 'readout'];
const RASTER_HEIGHT = 150;  // CSS pixels of every raster, whatever its population
const FULL = 4;  // an attention weight of so many times the equal weight has the full colour
const EVEN = 1.25;  // attention within this factor of the equal weight is even, and what remains is noise
const SYMBOLS = {RETURN_TO_GO: 'G', STATE: 's', ACTION: 'a'};
const KINDS = ['RETURN_TO_GO', 'STATE', 'ACTION'];

/** Draws a decision into `target`. `kind` limits the rasters to one kind of token; empty: all. */
export function drawDecision(target, decision, kind) {
  const blocks = [summary(decision), ...rasters(decision, kind)];
  if (decision.routing.length) blocks.push(section('Routing gates', decision.routing.map((gates) => gateFigure(decision, gates))));
  blocks.push(section('Attention of the state token', decision.attention.map((layer) => attentionFigure(decision, layer))));
  target.replaceChildren(...blocks);
}

function section(title, figures, className = 'wide') {
  return element('div', {}, element('h3', {textContent: title}), element('div', {className}, ...figures));
}

/** Returns a row with a name, a bar of a length in [0, 1] and a value. */
function barRow(name, share, value) {
  const bar = element('span', {className: 'meter'});
  bar.style.setProperty('--share', `${100 * Math.min(1, Math.max(0, share))}%`);
  return element('div', {className: 'bar-row'}, element('span', {textContent: name}), bar,
                 element('span', {textContent: value}));
}

/** Returns a row with a value of an observation on an axis on which the usual values of training are shaded. */
export function rangeRow(name, {value, mean, deviation, unusual}) {
  // Two deviations on either side take the middle third of the axis, unless the value is farther away.
  const reach = Math.max(6 * deviation, 1.1 * Math.abs(value - mean)) || 1;
  const place = (x) => `${50 + 50 * Math.min(1, Math.max(-1, (x - mean) / reach))}%`;
  const axis = element('span', {className: unusual ? 'meter range unusual' : 'meter range'},
                       element('span', {className: 'usual'}), element('span', {className: 'mark'}));
  axis.style.setProperty('--share', '0%');
  axis.style.setProperty('--from', place(mean - 2 * deviation));
  axis.style.setProperty('--to', place(mean - 2 * deviation));
  axis.style.setProperty('--at', place(value));
  axis.title = `training: ${fixed(mean, 3)} ± ${fixed(deviation, 3)}`;
  return element('div', {className: unusual ? 'bar-row unusual' : 'bar-row'}, element('span', {textContent: name}), axis,
                 element('span', {textContent: fixed(value, 3)}));
}

function bars(title, rows, note) {
  const quiet = note ? [element('p', {className: 'quiet', textContent: note})] : [];
  return element('figure', {}, element('figcaption', {textContent: title}), ...rows, ...quiet);
}

/** Returns the energy with memory and without, or for a policy in float32 that of horowitz_45nm. */
function energyText(stats) {
  if (!isNumber(stats.int_sram_energy_joules)) return `${si(stats.energy_joules, 'J')} by horowitz_45nm`;
  return `${si(stats.int_sram_energy_joules, 'J')} by int_sram_45nm, ${si(stats.int_energy_joules, 'J')} without memory`;
}

/** Says what the decision was in a sentence, and shows its input, its alternatives and its cost. */
function summary(decision) {
  const {answer} = decision;
  const continuous = answer.action.continuous?.values;
  const action = continuous ? continuous.map((x) => fixed(x, 3)).join(', ') : answer.action.discrete;
  const sentence = element('p', {className: 'verdict'}, 'Action ', element('strong', {textContent: action}),
    ` at step ${answer.step} of episode ${decision.episode}, with return-to-go ${fixed(answer.return_to_go, 1)}: ` +
    `${count(Number(answer.stats.spikes))} spikes, ` +
    `${energyText(answer.stats)} (estimate).`);
  const largest = Math.max(...decision.observation.map(Math.abs), 1e-9);
  const observation = bars('Observation', decision.observation.map((x, i) =>
    barRow(`${i}`, Math.abs(x) / largest, fixed(x, 3))), `policy ${decision.policy}/${decision.version}, ${decision.mode}`);
  const probabilities = answer.action_probabilities;
  const choice = probabilities.length
    ? bars('Probabilities of the actions', probabilities.map((p, i) => barRow(`${i}`, p, fixed(p, 3))),
           `logits ${decision.logits.map((x) => fixed(x, 2)).join(', ')}`)
    : bars('Action', (continuous ?? []).map((x, i) => barRow(`${i}`, Math.abs(x) / Math.max(...continuous.map(Math.abs), 1e-9), fixed(x, 3))), 'continuous');
  const byStage = Object.entries(answer.stats.spikes_by_stage ?? {}).map(([stage, n]) => [stage, Number(n)]);
  const most = Math.max(...byStage.map(([, n]) => n), 1);
  const stages = bars('Spikes by stage', byStage.map(([stage, n]) => barRow(stage, n / most, count(n))));
  return element('div', {}, sentence, element('div', {className: 'wide'}, observation, choice, ...(byStage.length ? [stages] : [])));
}

/** The mean gate of each head for the last token: how much each head counts. */
function gateFigure({heads, ticks}, {layer, gates}) {
  const last = gates.slice(-ticks * heads);
  const means = Array.from({length: heads}, (_, head) =>
    last.filter((__, i) => i % heads === head).reduce((sum, gate) => sum + gate, 0) / ticks);
  const first = means.indexOf(Math.max(...means));
  const figure = bars(`Layer ${layer}`, means.map((mean, head) => barRow(`head ${head}`, mean, fixed(mean, 2))),
                      `Head ${first} has the largest gate for the state token, mean of ${ticks} ticks.`);
  figure.setAttribute('aria-label', `routing gates of layer ${layer}`);
  return figure;
}

/** The attention of each head over the timesteps of the context, mean over the ticks. */
function attentionFigure({heads}, {layer, ticks, keys, weights}) {
  const n = keys.length;
  const mean = (head, key) => {
    let sum = 0;
    for (let tick = 0; tick < ticks; ++tick) sum += weights[(tick * heads + head) * n + key];
    return sum / ticks;
  };
  const steps = [...new Set(keys.map(({timestep}) => Number(timestep)))];
  const now = steps[steps.length - 1];
  let best = {weight: -1};
  const cells = [];
  for (let head = 0; head < heads; ++head) {
    keys.forEach((key, i) => {
      const weight = mean(head, i);
      if (weight > best.weight) best = {weight, head, key};
      cells.push({x: steps.indexOf(Number(key.timestep)) * 3 + KINDS.indexOf(key.kind), y: head, weight});
    });
  }
  const even = 1 / n;
  const all = cells.map(({weight}) => weight);
  const [least, largest] = [Math.min(...all), Math.max(...all)];
  if (n > 1 && largest < EVEN * even && least > even / EVEN) {
    const figure = element('figure', {}, element('figcaption', {textContent: `Layer ${layer}`}),
      element('p', {className: 'even', textContent: `Every head looks at all ${n} tokens about equally: weights ` +
        `${fixed(least, 3)} to ${fixed(largest, 3)}, equal ones would be ${fixed(even, 3)}. There is nothing to draw.`}));
    figure.setAttribute('aria-label', `attention of layer ${layer}: even over ${n} tokens`);
    return figure;
  }
  const lines = steps.map((_, i) => i * 3);
  const map = canvas(steps.length * 3, heads, heads * 22, lines, (paint) => {
    for (const {x, y, weight} of cells) paint(x, y, weight / Math.max(best.weight, FULL * even));
  }, `attention of layer ${layer}: ${heads} heads over ${n} tokens of ${steps.length} timesteps`);
  const ago = now - Number(best.key.timestep);
  const place = ago === 0 ? 'of this timestep' : `${ago} step${ago === 1 ? '' : 's'} ago`;
  return element('figure', {}, element('figcaption', {textContent: `Layer ${layer}`}),
    element('div', {className: 'axes'},
            element('div', {className: 'rows'}, ...Array.from({length: heads}, (_, head) =>
              element('span', {textContent: `head ${head}`}))),
            map,
            element('div', {className: 'columns'},
                    element('span', {textContent: steps.length > 1 ? `${steps.length - 1} steps ago` : ''}),
                    element('span', {textContent: 'now'}))),
    element('p', {className: 'quiet', textContent: `Most: head ${best.head}, ${SYMBOLS[best.key.kind]} ${place}, ` +
      `weight ${fixed(best.weight, 3)}; equal weights would be ${fixed(even, 3)}. Columns G, s, a of each timestep.`}));
}

function rasters(decision, kind) {
  if (decision.rasters.length === 0) return [element('p', {textContent: 'A dense policy has no spikes.'})];
  const wanted = decision.rasters.filter((raster) => !kind || raster.token.kind === kind);
  const layers = [...new Set(wanted.map((raster) => raster.layer))].sort((a, b) => (a ?? 1e9) - (b ?? 1e9));
  return layers.map((layer) => {
    const figures = STAGES.flatMap((stage) => {
      const some = wanted.filter((raster) => raster.layer === layer && raster.stage === stage);
      return some.length ? [rasterFigure(stage, some, decision.ticks)] : [];
    });
    return section(layer === undefined ? 'Spikes outside the layers' : `Spikes of layer ${layer}`, figures, 'rasters');
  });
}

/** Draws the spikes of one stage: one row per neuron, one column per tick, the tokens side by side. */
function rasterFigure(stage, all, ticks) {
  const spikes = all.reduce((sum, raster) => sum + raster.ticks.length, 0);
  const population = all[0].population;
  const names = all.map(({token}) => SYMBOLS[token.kind]);
  const title = `${stage}: ${spikes} spike${spikes === 1 ? '' : 's'}`;
  const map = canvas(all.length * ticks, population, RASTER_HEIGHT, all.map((_, i) => i * ticks), (paint) => {
    all.forEach((raster, i) => raster.ticks.forEach((tick, j) => paint(i * ticks + tick, raster.neurons[j], 1)));
  }, `${title} of ${population} neurons over ${ticks} ticks of ${names.join(', ')}`);
  const tokens = element('div', {className: 'tokens'}, ...names.map((name) => element('span', {textContent: name})));
  return element('figure', {}, element('figcaption', {textContent: title}), map, tokens,
                 element('p', {className: 'quiet', textContent: `${population} neurons, ${ticks} ticks`}));
}

/**
 * Returns a canvas of `rows` x `columns` cells, as wide as its place and `height` CSS pixels high. `fill(paint)` calls
 * paint(column, row, opacity) for the cells that are not empty; each is at least two pixels high, so that a single
 * spike of a large population can be seen. Draws a line before each column in `lines`.
 */
function canvas(columns, rows, height, lines, fill, description) {
  const scale = 2;  // for sharp cells on screens of high density
  const width = 360;
  const made = element('canvas', {className: 'map', width: width * scale, height: height * scale});
  made.style.setProperty('height', `${height}px`);
  made.setAttribute('role', 'img');
  made.setAttribute('aria-label', description);
  const style = getComputedStyle(document.documentElement);
  const context = made.getContext('2d');
  const [cellWidth, cellHeight] = [made.width / columns, made.height / rows];
  context.fillStyle = style.getPropertyValue('--ground');
  context.fillRect(0, 0, made.width, made.height);
  context.fillStyle = style.getPropertyValue('--line');
  for (const column of lines.slice(1)) context.fillRect(column * cellWidth - 1, 0, 2, made.height);
  context.fillStyle = style.getPropertyValue('--spike');
  fill((column, row, opacity) => {
    context.globalAlpha = opacity;
    context.fillRect(column * cellWidth, row * cellHeight, Math.max(cellWidth - 2, 2), Math.max(cellHeight - 2, 4));
  });
  return made;
}
