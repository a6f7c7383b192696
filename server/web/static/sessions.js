// The table of sessions. The server filters, sorts and pages it, so the page stays fast with 100,000 sessions.
import {count, fixed, si} from './format.js';
import {Table} from './table.js';

const PAGE_SIZE = 50;

export class Sessions {
  /** `choose(id)` is called when the user selects a session. */
  constructor(choose) {
    this.offset = 0;
    this.filter = document.getElementById('filter');
    this.previous = document.getElementById('previous');
    this.next = document.getElementById('next');
    this.page = document.getElementById('page');
    const number = (key, label, format) => ({
      key, label, value: (row) => row[key], text: (row) => format(Number(row[key])),
    });
    this.table = new Table(document.getElementById('sessions-table'), [
      {key: 'session_id', label: 'Session', value: (row) => row.session_id, isText: true, fill: (cell, row) => {
        const button = document.createElement('button');
        button.type = 'button';
        button.textContent = row.session_id;
        button.setAttribute('aria-label', `Explain the last decision of session ${row.session_id}`);
        button.addEventListener('click', () => choose(row.session_id));
        cell.append(button);
      }},
      {key: 'policy', label: 'Policy', value: (row) => row.policy, text: (row) => `${row.policy}/${row.version}`,
       isText: true},
      number('episode', 'Episode', count),
      number('step', 'Step', count),
      number('episode_return', 'Return so far', fixed),
      number('decisions', 'Decisions', count),
      {key: 'spikes_per_decision', label: 'Spikes per decision', value: (row) => row.spikes,
       text: (row) => fixed(row.decisions > 0 ? row.spikes / row.decisions : undefined)},
      number('energy_joules', 'Energy so far (estimate)', (x) => si(x, 'J')),
      number('head_drift', 'Head drift', (x) => fixed(x, 4)),
      number('idle_seconds', 'Idle (s)', fixed),
      {key: 'labels', label: 'Labels', isText: true,
       text: (row) => Object.entries(row.tenant ? {...row.labels, tenant: row.tenant} : row.labels)
         .map(([key, value]) => `${key}=${value}`).join(' ')},
    ], {sort: 'energy_joules', descending: true, key: (row) => row.session_id, onSort: () => this.go(0)});
    this.filter.addEventListener('input', () => this.go(0));
    this.previous.addEventListener('click', () => this.go(Math.max(0, this.offset - PAGE_SIZE)));
    this.next.addEventListener('click', () => this.go(this.offset + PAGE_SIZE));
  }

  go(offset) {
    this.offset = offset;
    return this.refresh();
  }

  async refresh() {
    const query = new URLSearchParams({
      filter: this.filter.value, sort: this.table.sort, order: this.table.descending ? 'descending' : 'ascending',
      offset: this.offset, limit: PAGE_SIZE,
    });
    this.asked = query.toString();
    const response = await fetch(`sessions.json?${query}`);
    if (!response.ok) throw new Error((await response.json()).message);
    const {open, matching, sessions} = await response.json();
    if (this.asked !== query.toString()) return;  // another request was sent in the meantime
    if (sessions.length === 0 && this.offset > 0) {
      this.go(0);  // the sessions of this page were closed
      return;
    }
    this.table.show(sessions);
    const last = this.offset + sessions.length;
    this.page.textContent = matching === 0
      ? `none of ${count(open)} sessions`
      : `${count(this.offset + 1)} to ${count(last)} of ${count(matching)}` +
        (matching === open ? ' sessions' : `, of ${count(open)} sessions`);
    this.previous.disabled = this.offset === 0;
    this.next.disabled = last >= matching;
  }

  mark(id) {
    for (const [key, element] of this.table.rowElements) element.classList.toggle('chosen', key === id);
  }
}
