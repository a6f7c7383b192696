// Keeps the last samples of /status.json and computes figures over a window of them: rates from the difference of two
// samples, quantiles from the differences of histogram buckets.

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
    // The clock or a counter is behind the last sample: the server was restarted, or another one answers.
    const before = this.latest;
    if (before && (sample.time < before.time || total(sample) < total(before))) this.samples = [];
    this.samples.push(sample);
    while (this.samples[0].time < sample.time - KEPT_SECONDS) this.samples.shift();
  }

  /** Returns the window of the last `seconds`; with Infinity, since the server started. */
  window(seconds) {
    const to = this.latest;
    if (seconds === Infinity) return new Window(null, to);
    const from = this.samples.find((sample) => sample.time >= to.time - seconds);
    return new Window(from, to);
  }

  /** Returns one window for each pair of successive samples. */
  steps() {
    return this.samples.slice(1).map((to, i) => ({time: to.time, window: new Window(this.samples[i], to)}));
  }
}

/** Returns a map from metric name to a map from labels, as one string, to series. */
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

/** The figures between two samples. */
class Window {
  /** If `from` is null, the window starts when the server started. */
  constructor(from, to) {
    this.from = from;
    this.to = to;
  }

  /** The length of the window in seconds. Undefined if it is zero or unknown. */
  get duration() {
    const duration = this.from ? this.to.time - this.from.time : this.uptime();
    return duration > 0 ? duration : undefined;
  }

  uptime() {
    const started = this.gauge('process_start_time_seconds');
    return started === undefined ? undefined : Date.now() / 1000 - started;
  }

  /** Returns the series of a metric whose labels include `labels`. */
  matching(name, labels = {}) {
    const wanted = Object.entries(labels);
    return [...(this.to.series.get(name)?.entries() ?? [])]
      .filter(([, series]) => wanted.every(([label, value]) => series.labels[label] === value));
  }

  before(name, key) {
    return this.from?.series.get(name)?.get(key);
  }

  /** Returns the increase of a counter over the window, summed over the series whose labels include `labels`. */
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

  /** Returns {count, sum, buckets} over the window, summed over the histograms whose labels include `labels`. */
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
 * Returns the q-quantile as Prometheus estimates it, by interpolation within a bucket. Returns undefined without
 * observations, and null if the quantile lies beyond the last finite bucket bound.
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
