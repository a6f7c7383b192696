// The table of the servers that share one store, with the last report of each.
import {NOTHING, count, duration, element, fixed, percent, setText, si} from './format.js';
import {Table} from './table.js';

const LOST_SECONDS = 10;  // a server reports every 2 seconds

/** Returns the health of a server in words, and whether all is well. */
export function healthOfServer({seconds_ago: age, serving, alerts_firing: firing}) {
  if (age > LOST_SECONDS) return {good: false, words: `no sign of life for ${duration(Math.round(age))}`};
  if (!serving) return {good: false, words: 'draining'};
  return {good: firing === 0, words: firing ? `${firing} alert${firing === 1 ? '' : 's'} firing` : 'healthy'};
}

export class Servers {
  constructor() {
    const health = (row) => healthOfServer(row).words;
    const text = (key) => (row) => row[key].join(', ') || NOTHING;
    const number = (key, label, format) => ({key, label, value: (row) => row[key], text: (row) => format(row[key])});
    this.table = new Table(document.getElementById('servers-table'), [
      {key: 'address', label: 'Server', value: (row) => row.address, isText: true, fill: (cell, row) => {
        cell.append(element('a', {href: `${location.protocol}//${row.address}/`, textContent: row.address, title: row.replica}));
      }},
      {key: 'health', label: 'Health', value: health, text: health, isText: true, update: (cell, row) => {
        setText(cell, health(row));
        cell.classList.toggle('bad', !healthOfServer(row).good);
      }},
      number('sessions', 'Sessions', count),
      number('decisions_per_second', 'Decisions per second', fixed),
      number('call_p99_seconds', 'Call, p99', (x) => si(x, 's')),
      number('failed_ratio', 'Failed calls', percent),
      {key: 'playing', label: 'Playing', isText: true, text: text('playing')},
      {key: 'version', label: 'Version', value: (row) => row.version, text: (row) => row.version, isText: true},
    ], {sort: 'address', key: (row) => row.replica});
  }

  /** Shows the servers if there are several. */
  show({servers}, route) {
    document.getElementById('servers').hidden = servers.length < 2 || Boolean(route.policy || route.session);
    const alive = servers.filter((row) => row.seconds_ago <= LOST_SECONDS);
    const sum = (key) => alive.reduce((total, row) => total + row[key], 0);
    setText(document.getElementById('servers-sum'), `${alive.length} of ${servers.length} alive, with ` +
      `${count(sum('sessions'))} sessions and ${fixed(sum('decisions_per_second'))} decisions per second in the last minute.`);
    this.table.show(servers);
  }
}
