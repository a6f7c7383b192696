// The table of sessions. The server filters, sorts and pages it, so the page stays fast with 100,000 sessions.
import {fetchJson} from './fetch.js';
import {NOTHING, count, duration, element, energyOf, fixed, nameOf, needOf, sessionLink, setText, si} from './format.js';
import {Table} from './table.js';

const PAGE_SIZE = 50;
// The questions of operators: [text, column, descending].
const ORDERS = [
  ['Needs help', 'needs_help', true],
  ['Most energy', 'energy_joules_per_decision', true],
  ['Lowest return', 'mean_return', false],
  ['Most spikes', 'spikes_per_decision', true],
  ['Unusual observations', 'unusual_observations', true],
  ['Longest idle', 'idle_seconds', true],
];

/** Returns how many beats of a robot had no fresh action, and whether it is silent, held or steered by an operator. */
function notFresh({beats, silent, hold, at_neutral: atNeutral, operator_id: operator}) {
  const missed = beats && Number(beats.held) + Number(beats.local) + Number(beats.safe);
  const all = beats && missed + Number(beats.fresh);
  const held = hold !== null && `held${atNeutral ? '' : ', not confirmed'}`;
  return [beats && `${count(missed)} of ${count(all)}`, silent && 'silent', held, operator && `by ${operator}`]
    .filter(Boolean).join(', ') || NOTHING;
}

export class Sessions {
  constructor() {
    this.scope = '';  // policy/version, to which the list is limited; empty: all
    this.tokens = [''];  // of the pages up to the shown one
    this.filter = document.getElementById('filter');
    this.previous = document.getElementById('previous');
    this.next = document.getElementById('next');
    this.page = document.getElementById('page');
    const number = (key, label, format) => ({
      key, label, value: (row) => row[key], text: (row) => format(row[key] === null ? undefined : Number(row[key])),
    });
    this.table = new Table(document.getElementById('sessions-table'), [
      {key: 'session_id', label: 'Robot', value: (row) => row.session_id, isText: true, fill: (cell, row) => {
        cell.append(element('a', {href: sessionLink(row.session_id), textContent: nameOf(row),
                                  title: row.session_id}));
      }},
      {key: 'labels', label: 'Labels', isText: true,
       text: (row) => Object.entries(row.tenant ? {...row.labels, tenant: row.tenant} : row.labels)
         .map(([key, value]) => `${key}=${value}`).join(' ') || NOTHING},
      {key: 'policy', label: 'Policy', value: (row) => row.policy, text: (row) => `${row.policy}/${row.version}`,
       isText: true},
      number('mean_return', 'Mean return', fixed),
      number('last_return', 'Last return', fixed),
      number('episode_return', 'Return so far', fixed),
      number('episode', 'Episode', count),
      number('step', 'Step', count),
      number('decisions', 'Decisions', count),
      {key: 'spikes_per_decision', label: 'Spikes per decision', value: (row) => row.spikes,
       text: (row) => fixed(row.decisions > 0 ? row.spikes / row.decisions : undefined)},
      {key: 'energy_joules_per_decision', label: 'Energy of a decision',
       value: (row) => row.energy_joules_per_decision.int_sram_45nm, text: (row) => energyOf(row).join(' '), update: (cell, row) => {
        [cell.textContent, cell.title] = energyOf(row);
      }},
      number('unusual_observations', 'Unusual now', count),
      {key: 'needs_help', label: 'Needs help', value: (row) => row.needs_help?.score,
       text: (row) => needOf(row).join(' '), update: (cell, row) => {
         [cell.textContent, cell.title] = needOf(row);
       }},
      number('head_drift', 'Head drift', (x) => fixed(x, 4)),
      {key: 'beats', label: 'Beats not fresh', text: notFresh},
      number('idle_seconds', 'Idle', duration),
    ], {sort: 'energy_joules_per_decision', descending: true, key: (row) => row.session_id, onSort: () => this.restart()});
    this.filter.addEventListener('input', () => this.restart());
    this.previous.addEventListener('click', () => {
      this.tokens.pop();
      this.refresh();
    });
    this.next.addEventListener('click', () => {
      this.tokens.push(this.nextToken);
      this.refresh();
    });
    this.orders = ORDERS.map(([text, column, descending]) => {
      const button = element('button', {type: 'button', textContent: text});
      button.addEventListener('click', () => this.table.setSort(column, descending));
      return {button, column, descending};
    });
    document.getElementById('orders').append(...this.orders.map(({button}) => button));
  }

  /** Limits the list to the sessions of a policy version. */
  setScope(scope) {
    if (scope === this.scope) return;
    this.scope = scope;
    this.tokens = [''];
    this.filter.value = scope;
  }

  restart() {
    this.tokens = [''];
    return this.refresh();
  }

  async refresh() {
    const query = {
      filter: this.filter.value, sort: this.table.sort, order: this.table.descending ? 'descending' : 'ascending',
      page_size: PAGE_SIZE, page_token: this.tokens[this.tokens.length - 1],
    };
    this.asked = JSON.stringify(query);
    const {open, matching, sessions, next_page_token: token} = await fetchJson('sessions.json', query);
    if (this.asked !== JSON.stringify(query)) return;  // another request was sent in the meantime
    if (sessions.length === 0 && this.tokens.length > 1) {
      this.restart();  // the sessions of this page were closed
      return;
    }
    this.nextToken = token;
    this.table.show(sessions);
    const before = (this.tokens.length - 1) * PAGE_SIZE;
    setText(this.page, matching === 0
      ? `none of ${count(open)} sessions`
      : `${count(before + 1)} to ${count(before + sessions.length)} of ${count(matching)}` +
        (matching === open ? ' sessions' : `, of ${count(open)} sessions`));
    this.previous.disabled = this.tokens.length === 1;
    this.next.disabled = token === '';
    for (const {button, column, descending} of this.orders) {
      button.setAttribute('aria-pressed', String(this.table.sort === column && this.table.descending === descending));
    }
  }
}
