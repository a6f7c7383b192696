// What /status.json said over time, and figures over a window of it: every rate is a difference of
// two samples, every quantile one of the differences of histogram buckets.

const KEPT_SECONDS = 600;

export class Samples {
  constructor() {
    this.samples = [];  // oldest first
  }

  get latest() {
    return this.samples[this.samples.length - 1];
  }

  add(status) {
    const sample = {time: status.time, status, series: index(status.metrics)};
    // A clock that went back, or a counter that fell: another server answers now.
    const before = this.latest;
    if (before && (sample.time < before.time || total(sample) < total(before))) this.samples = [];
    this.samples.push(sample);
    while (this.samples[0].time < sample.time - KEPT_SECONDS) this.samples.shift();
  }

  /** The figures over the last `seconds`, or since the server started for Infinity. */
  window(seconds) {
    const to = this.latest;
    if (seconds === Infinity) return new Window(null, to);
    const from = this.samples.find((sample) => sample.time >= to.time - seconds);
    return new Window(from, to);
  }

  /** The figures between each sample and the one before. */
  steps() {
    return this.samples.slice(1).map((to, i) => ({time: to.time, window: new Window(this.samples[i], to)}));
  }
}

/** The series of each metric by their labels, as one string. */
function index(metrics) {
  const byName = new Map();
  for (const [name, list] of Object.entries(metrics)) {
    byName.set(name, new Map(list.map((series) => [keyOf(series.labels), series])));
  }
  return byName;
}

function keyOf(labels) {
  return Object.keys(labels).sort().map((name) => `${name}=${labels[name]}`).join('\n');
}

function total(sample) {
  let sum = 0;
  for (const series of sample.series.get('spikeserve_decisions_total')?.values() ?? []) sum += series.value;
  return sum;
}

class Window {
  /** `from` null: since the server started. */
  constructor(from, to) {
    this.from = from;
    this.to = to;
  }

  /** Undefined where there is no time between the samples, or not known how much. */
  get duration() {
    const duration = this.from ? this.to.time - this.from.time : this.uptime();
    return duration > 0 ? duration : undefined;
  }

  uptime() {
    const started = this.gauge('process_start_time_seconds');
    return started === undefined ? undefined : Date.now() / 1000 - started;
  }

  /** The series of a metric whose labels include these. */
  matching(name, labels = {}) {
    const wanted = Object.entries(labels);
    return [...(this.to.series.get(name)?.entries() ?? [])]
      .filter(([, series]) => wanted.every(([label, value]) => series.labels[label] === value));
  }

  before(name, key) {
    return this.from?.series.get(name)?.get(key);
  }

  /** By how much counters grew, those of these labels together. */
  increase(name, labels) {
    return this.matching(name, labels)
      .reduce((sum, [key, series]) => sum + series.value - (this.before(name, key)?.value ?? 0), 0);
  }

  rate(name, labels) {
    return this.duration === undefined ? undefined : this.increase(name, labels) / this.duration;
  }

  gauge(name, labels) {
    const values = this.matching(name, labels).map(([, series]) => series.value);
    return values.length ? values.reduce((a, b) => a + b, 0) : undefined;
  }

  /** {count, sum, buckets} of histograms of these labels together, over the window. */
  histogram(name, labels) {
    const result = {count: 0, sum: 0, buckets: []};
    for (const [key, series] of this.matching(name, labels)) {
      const before = this.before(name, key);
      result.count += series.count - (before?.count ?? 0);
      result.sum += series.sum - (before?.sum ?? 0);
      series.buckets.forEach(([bound, cumulative], i) => {
        result.buckets[i] ??= [bound, 0];
        result.buckets[i][1] += cumulative - (before?.buckets[i]?.[1] ?? 0);
      });
    }
    return result;
  }
}

/**
 * The q-quantile as Prometheus estimates it, by interpolation inside a bucket. Undefined without observations, null
 * beyond the last finite bound.
 */
export function quantile(histogram, q) {
  if (histogram.count === 0) return undefined;
  const rank = q * histogram.count;
  const i = histogram.buckets.findIndex(([, cumulative]) => cumulative >= rank);
  const [bound, cumulative] = histogram.buckets[i];
  if (bound === null) return null;
  const lower = i === 0 ? Math.min(0, bound) : histogram.buckets[i - 1][0];
  const below = i === 0 ? 0 : histogram.buckets[i - 1][1];
  return lower + (bound - lower) * (rank - below) / (cumulative - below);
}
