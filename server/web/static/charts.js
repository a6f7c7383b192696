// The charts over time, with one line per policy version.
import {si} from './format.js';
import {policyRows} from './policies.js';

const CHARTS = [
  ['chart-decisions', (row) => row.decisionRate],
  ['chart-power', (row) => row.power],
  ['chart-spikes', (row) => row.spikes],
  ['chart-latency', (row) => row.p99 ?? undefined],
];
const HEIGHT = 170;
const SECONDS = 60;  // the shortest time that a chart spans, so that a new chart does not rescale every second
const LINES = 8;  // more lines cannot be told apart; the tables show all versions
// Colours by Okabe and Ito, distinguishable for the colour-blind, on a light and a dark background.
const COLOURS = ['#0072b2', '#d55e00', '#009e73', '#cc79a7', '#e69f00', '#56b4e9', '#8a8f00', '#888888'];

export class Charts {
  constructor() {
    this.keys = [];
    this.plots = [];
    this.known = new WeakMap();
    const rebuild = () => {
      this.keys = [];  // makes show() build the charts again
      if (this.shown) this.show(...this.shown);
    };
    matchMedia('(prefers-color-scheme: dark)').addEventListener('change', rebuild);
    addEventListener('resize', rebuild);
  }

  show(samples, energyModel) {
    this.shown = [samples, energyModel];
    const steps = samples.steps().map(({time, window}) => ({time, rows: this.rowsOf(window, energyModel)}));
    if (steps.length === 0) return;
    const end = steps[steps.length - 1];
    const keys = [...end.rows].sort((a, b) => (b.energyTotal ?? 0) - (a.energyTotal ?? 0)).slice(0, LINES).map((row) => row.key);
    if (keys.join() !== this.keys.join()) this.build(keys);
    const times = steps.map(({time}) => time - end.time);
    CHARTS.forEach(([, figure], i) => {
      const lines = keys.map((key) => steps.map(({rows}) => {
        const row = rows.find((candidate) => candidate.key === key);
        return row && figure(row);
      }));
      const plot = this.plots[i];
      plot.setData([times, ...lines]);
      // Shows the latest values in the legend unless the cursor is on the chart. uPlot clears the legend when it draws,
      // so this waits for the next frame.
      requestAnimationFrame(() => {
        if (plot.cursor.idx == null) plot.setLegend({idx: times.length - 1});
      });
    });
  }

  /** Returns the rows of a window. They do not change for a given sample, so they are cached by sample. */
  rowsOf(window, energyModel) {
    let known = this.known.get(window.to);
    if (known?.energyModel !== energyModel) {
      known = {energyModel, rows: policyRows(window, energyModel)};
      this.known.set(window.to, known);
    }
    return known.rows;
  }

  build(keys) {
    this.keys = keys;
    const style = getComputedStyle(document.documentElement);
    const axis = {
      stroke: style.getPropertyValue('--ink'), grid: {stroke: style.getPropertyValue('--grid')},
      ticks: {stroke: style.getPropertyValue('--grid')}, font: '11px system-ui',
    };
    this.plots.forEach((plot) => plot.destroy());
    this.plots = CHARTS.map(([id]) => {
      const element = document.getElementById(id);
      return new uPlot({
        width: Math.max(element.clientWidth, 200), height: HEIGHT, cursor: {drag: {x: false, y: false}},
        scales: {x: {time: false, range: (_, low) => [Math.min(-SECONDS, low ?? 0), 0]}, y: {range: (_, low, high) => [Math.min(0, low ?? 0), (high ?? 0) * 1.1 || 1]}},
        axes: [
          {...axis, values: (_, ticks) => ticks.map((t) => `${t} s`)},
          {...axis, size: 60, values: (_, ticks) => ticks.map((y) => si(y, ''))},
        ],
        series: [
          {label: 'seconds ago', value: (_, t) => (t == null ? '' : `${(-t).toFixed(0)}`)},
          ...keys.map((key, i) => ({
            label: key, stroke: COLOURS[i], width: 2, points: {show: false},
            value: (_, y) => (y == null ? '' : si(y, '')),
          })),
        ],
      }, [[], ...keys.map(() => [])], element);
    });
  }
}
