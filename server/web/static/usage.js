// What was used this month, from the ledger: energy by day, a table, and the budgets.
import {COLOURS, makeChart} from './charts.js';
import {fetchJson} from './fetch.js';
import {NOTHING, count, duration, element, percent, setText, si} from './format.js';
import {Table} from './table.js';

const ROWS = 50;
const DAY = 86400;
const DAYS = [1, 2, 5, 10];

const joulesOf = ({usage}, model) => usage.joules[model];

/** Returns what a line of the chart is about: a tenant, or a policy where there are no tenants. */
const nameOfLine = ({tenant, policy}) => tenant || policy || NOTHING;

export class Usage {
  constructor() {
    const number = (key, label, value, format) => ({key, label, value, text: (row) => format(value(row))});
    const text = (key, label) => ({key, label, isText: true, value: (row) => row[key], text: (row) => row[key] || NOTHING});
    const of = (key) => (row) => Number(row.usage[key]);
    this.model = 'int_sram_45nm';
    this.table = new Table(document.getElementById('usage-table'), [
      text('tenant', 'Tenant'), text('policy', 'Policy'), text('label', 'Label'),
      number('energy', 'Energy (estimate)', (row) => joulesOf(row, this.model), (x) => si(x, 'J')),
      number('decisions', 'Decisions', of('decisions'), count),
      number('spikes', 'Spikes', of('spikes'), (x) => si(x)),
      number('sessions', 'Sessions', of('sessions'), count),
      number('time', 'Time open', of('session_seconds'), duration),
      number('refused', 'Refused calls', of('refused_calls'), count),
    ], {sort: 'energy', descending: true, key: (row) => `${row.tenant}\n${row.policy}\n${row.label}`});
    this.lines = [];
  }

  /** Fetches the month and shows it. */
  async refresh() {
    const [days, rows] = await Promise.all(
      ['day,tenant,policy', 'tenant,policy,label'].map((by) => fetchJson('usage.json', {by})));
    this.days = days;
    this.rows = rows;
    this.show(this.model);
  }

  show(model) {
    this.model = model;
    if (!this.days) return;
    const {month, label_key: key, budgets, resets_at: resets} = this.rows;
    const energy = (row) => joulesOf(row, model) ?? 0;
    const sum = this.rows.rows.reduce((total, row) => total + energy(row), 0);
    const rows = [...this.rows.rows].sort((a, b) => energy(b) - energy(a));
    setText(document.getElementById('usage-sum'), `${month} (UTC): ${si(sum, 'J')} by ${model}` +
      (rows.length > ROWS ? `; the ${ROWS} of ${rows.length} rows that used most` : '') +
      (key ? `. Label: ${key}.` : '.'));
    this.table.show(rows.slice(0, ROWS));
    document.getElementById('usage-budgets').replaceChildren(...budgets.map(({tenant, name, limit, spent}) =>
      element('li', {className: spent >= limit ? 'bad' : '', textContent:
        `${tenant}: ${percent(spent / limit)} of ${si(limit)} ${name}, until ${new Date(1000 * resets).toISOString()}`})));
    this.draw(energy);
  }

  draw(energy) {
    const totals = new Map();  // by line, and by day of the month
    for (const row of this.days.rows) {
      const name = nameOfLine(row);
      const day = new Date(1000 * row.start).getUTCDate();
      if (!totals.has(name)) totals.set(name, new Map());
      totals.get(name).set(day, (totals.get(name).get(day) ?? 0) + energy(row));
    }
    const all = (days) => [...days.values()].reduce((sum, x) => sum + x, 0);
    const lines = [...totals].sort(([, a], [, b]) => all(b) - all(a)).slice(0, COLOURS.length);
    const target = document.getElementById('usage-chart');
    const names = lines.map(([name], i) => ({label: name, colour: COLOURS[i]}));
    if (this.lines.join() !== names.map(({label}) => label).join() || !this.plot) {
      this.plot?.destroy();
      target.replaceChildren();
      this.lines = names.map(({label}) => label);
      this.plot = makeChart(target, 'Energy of each day (estimate)', names, (x) => `${x}.`, (y) => si(y, 'J'),
        () => [1, 31], DAYS, DAY);
      document.getElementById('usage-legend').replaceChildren(...names.flatMap(({label, colour}) => {
        const swatch = element('span', {className: 'swatch'});
        swatch.style.setProperty('background', colour);
        return [element('span', {}, swatch, label)];
      }));
    }
    const days = Array.from({length: 31}, (_, i) => i + 1);
    this.plot.setData([days, ...lines.map(([, of]) => days.map((day) => of.get(day) ?? null))]);
  }
}
