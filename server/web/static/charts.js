// The charts over time: one line per policy version, or one line for one session.
import {element, policyLink, si, fixed} from './format.js';

const CHARTS = [
  {title: 'Decisions per second', of: (row) => row.decisions_per_second, format: (y) => si(y)},
  {title: 'Time of a decision, p99', of: (row) => row.decision_p99_seconds, format: (y) => si(y, 's')},
  {title: 'Return of an episode', of: (row) => row.return_mean, format: (y) => fixed(y)},
  {title: 'Energy per second (estimate)', of: (row, model) => row.energy_joules_per_second[model],
   format: (y) => si(y, 'J')},
];
const HEIGHT = 150;
const BRIDGED_SECONDS = 30;  // between two episodes there is no return, for example
const MINUTES = [30, 60, 120, 180, 300, 600];  // in seconds
const LINES = 8;  // more lines cannot be told apart; the tables show all versions
// Colours by Okabe and Ito, distinguishable for the colour-blind, on a light and a dark background.
export const COLOURS = ['#0072b2', '#d55e00', '#009e73', '#cc79a7', '#e69f00', '#56b4e9', '#8a8f00', '#888888'];

function axisStyle() {
  const style = getComputedStyle(document.documentElement);
  const grid = {stroke: style.getPropertyValue('--grid'), width: 1};
  return {stroke: style.getPropertyValue('--quiet'), grid, ticks: {show: false}, font: '11px system-ui'};
}

/**
 * Makes a chart in a figure of its own. `lines` is a list of {label, colour}; `formatX` and `formatY` write the numbers
 * of the axes, whose x axis has ticks at multiples of one of `stepsX`. A line crosses missing values over at most
 * `longestBridge` of the x axis. The caption shows the values under the cursor.
 */
export function makeChart(target, title, lines, formatX, formatY, rangeX, stepsX, longestBridge = 0) {
  // A line crosses what is missing only if it is short; what was not measured is a gap.
  const gaps = (plot, series, from, to, missing) => missing.filter(([left, right]) =>
    plot.posToVal(right, 'x', true) - plot.posToVal(left, 'x', true) > longestBridge);
  const alone = (plot, series) => plot.data[series].flatMap((y, i, all) =>
    (y != null && all[i - 1] == null && all[i + 1] == null ? [i] : []));
  const readout = element('span', {className: 'quiet'});
  const box = element('div');
  target.append(element('figure', {}, element('figcaption', {textContent: title}, ' ', readout), box));
  const axis = axisStyle();
  return new uPlot({
    width: Math.max(box.clientWidth, 160), height: HEIGHT, legend: {show: false},
    cursor: {drag: {x: false, y: false}, points: {size: 6}},
    padding: [6, 16, 0, 0],
    scales: {
      x: {time: false, range: rangeX},
      y: {range: (_, low, high) => [Math.min(0, low ?? 0), Math.max(0, (high ?? 0) * 1.1) || 1]},
    },
    axes: [
      {...axis, size: 22, space: 60, incrs: stepsX, values: (_, ticks) => ticks.map(formatX)},
      {...axis, size: 52, space: 32, values: (_, ticks) => ticks.map(formatY)},
    ],
    series: [{}, ...lines.map(({label, colour}) => (
      {label, stroke: colour, width: 2, gaps, points: {show: true, size: 4, fill: colour, filter: alone}}))],
    hooks: {setCursor: [(plot) => {
      const i = plot.cursor.idx;
      const values = i == null ? [] : plot.data.slice(1).map((ys) => formatY(ys[i])).filter((y) => y !== '–');
      readout.textContent = values.length ? `${values.join(' · ')} at ${formatX(plot.data[0][i])}` : '';
    }]},
  }, [[], ...lines.map(() => [])], box);
}

export class Charts {
  constructor(target, legend) {
    this.target = target;
    this.legend = legend;
    this.plots = [];
    const rebuild = () => {
      this.built = undefined;  // makes show() build the charts again
      if (this.shown) this.show(...this.shown);
    };
    matchMedia('(prefers-color-scheme: dark)').addEventListener('change', rebuild);
    addEventListener('resize', rebuild);
  }

  /** Shows the versions that used the most energy, or the version that the route names. */
  show(history, route, model) {
    this.shown = [history, route, model];
    if (route.session) return;
    const energy = (row) => (row.energy_joules_per_second?.[model] ?? []).reduce((sum, x) => sum + (x ?? 0), 0);
    const rows = route.policy
      ? history.versions.filter((row) => row.policy === route.policy && row.version === route.version)
      : [...history.versions].sort((a, b) => energy(b) - energy(a)).slice(0, LINES);
    const names = rows.map((row) => `${row.policy}/${row.version}`);
    if (names.join() !== this.built) this.build(rows, names);
    const times = history.seconds_ago.map((seconds) => -seconds);
    CHARTS.forEach(({of}, i) => this.plots[i].setData([times, ...rows.map((row) => of(row, model) ?? times.map(() => null))]));
  }

  build(rows, names) {
    this.built = names.join();
    this.plots.forEach((plot) => plot.destroy());
    this.target.replaceChildren();
    const lines = names.map((label, i) => ({label, colour: COLOURS[i]}));
    const ago = (x) => (x === 0 ? 'now' : `${+(x / 60).toFixed(1)} min`.replace('-', '−'));
    this.plots = CHARTS.map(({title, format}) =>
      makeChart(this.target, title, lines, ago, format, (_, low) => [Math.min(-60, low ?? 0), 0], MINUTES, BRIDGED_SECONDS));
    this.legend.replaceChildren(...rows.flatMap((row, i) => {
      const swatch = element('span', {className: 'swatch'});
      swatch.style.setProperty('background', COLOURS[i]);
      return [element('a', {href: policyLink(row.policy, row.version)}, swatch, names[i])];
    }));
  }
}
