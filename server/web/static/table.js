// A table that the user sorts by selecting a column heading. It updates its cells in place, so that the keyboard focus
// is kept.

/**
 * columns: a list of {key, label, value(row), text(row), share(row), isText, fill(cell, row), update(cell, row)}. A column without `value`
 * cannot be sorted. `share` in [0, 1] draws a bar. `fill` fills in a new cell once; `update` fills in a cell whenever its
 * text has changed.
 * options: {sort, descending, key(row), onSort(sort, descending)}. With onSort, the caller of show() sorts the rows.
 */
export class Table {
  constructor(element, columns, options) {
    this.element = element;
    this.columns = columns;
    this.options = options;
    this.sort = options.sort;
    this.descending = options.descending ?? false;
    this.rows = [];
    this.rowElements = new Map();
    this.texts = new WeakMap();  // by cell
    this.heads = new Map();  // by column
    this.body = document.createElement('tbody');
    element.replaceChildren(this.makeHead(), this.body);
    this.markSort();
  }

  makeHead() {
    const head = document.createElement('thead');
    const row = head.insertRow();
    for (const column of this.columns) {
      const cell = document.createElement('th');
      cell.scope = 'col';
      if (column.isText) cell.className = 'text';
      if (column.value) {
        const button = document.createElement('button');
        button.type = 'button';
        button.textContent = column.label;
        button.addEventListener('click', () => this.sortBy(column));
        cell.append(button);
      } else {
        cell.textContent = column.label;
      }
      row.append(cell);
      this.heads.set(column, cell);
    }
    return head;
  }

  sortBy(column) {
    // The first click on a column of numbers sorts the largest first.
    this.setSort(column.key, this.sort === column.key ? !this.descending : !column.isText);
  }

  setSort(key, descending) {
    this.sort = key;
    this.descending = descending;
    this.markSort();
    if (this.options.onSort) this.options.onSort(this.sort, this.descending);
    else this.show(this.rows);
  }

  markSort() {
    for (const [column, head] of this.heads) {
      if (column.key === this.sort) {
        head.setAttribute('aria-sort', this.descending ? 'descending' : 'ascending');
      } else {
        head.removeAttribute('aria-sort');
      }
    }
  }

  show(rows) {
    this.rows = rows;
    const sorted = this.options.onSort ? rows : this.sorted(rows);
    const focused = document.activeElement;
    const keys = sorted.map((row) => this.options.key(row));
    for (const [key, element] of this.rowElements) {
      if (keys.includes(key)) continue;
      element.remove();
      this.rowElements.delete(key);
    }
    sorted.forEach((row, i) => {
      const element = this.rowElements.get(keys[i]) ?? this.makeRow(keys[i], row);
      if (this.body.rows[i] !== element) this.body.insertBefore(element, this.body.rows[i] ?? null);
      this.fillRow(element, row);
    });
    if (focused !== document.activeElement && focused?.isConnected) focused.focus({preventScroll: true});
  }

  sorted(rows) {
    const column = this.columns.find(({key}) => key === this.sort);
    const sign = this.descending ? -1 : 1;
    // Rows without a value are last in both orders.
    const missing = (x) => x === undefined || x === null || Number.isNaN(x);
    return [...rows].sort((a, b) => {
      const [x, y] = [column.value(a), column.value(b)];
      if (missing(x) || missing(y)) return missing(x) - missing(y);
      return sign * (typeof x === 'string' ? x.localeCompare(y) : x - y);
    });
  }

  makeRow(key, row) {
    const element = document.createElement('tr');
    this.rowElements.set(key, element);
    for (const column of this.columns) {
      const cell = element.insertCell();
      if (column.isText) cell.className = 'text';
      cell.dataset.label = column.label;  // which a narrow screen shows in front of the value
      if (column.share) cell.classList.add('bar');
      column.fill?.(cell, row);
    }
    return element;
  }

  fillRow(element, row) {
    this.columns.forEach((column, i) => {
      const cell = element.cells[i];
      if (column.share) cell.style.setProperty('--share', `${100 * (column.share(row) || 0)}%`);
      if (!column.text) return;
      const text = column.text(row);
      if (this.texts.get(cell) === text) return;
      this.texts.set(cell, text);
      if (column.update) column.update(cell, row);
      else cell.textContent = text;
    });
  }
}
