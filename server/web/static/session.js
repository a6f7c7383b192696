// Shows one session: its figures, its history, and its last decisions one by one.
import {makeChart} from './charts.js';
import {drawDecision, rangeRow} from './explain.js';
import {fetchJson} from './fetch.js';
import {NOTHING, count, duration, element, energyOf, fixed, nameOf, needOf, setText, si} from './format.js';
import {Scene} from './scene.js';
import {Seat} from './seat.js';
import {TileGrid} from './tiles.js';
import {Undo} from './undo.js';

const KEPT_DECISIONS = 120;
const PLAY_MILLISECONDS = 250;
const SHOWN_ELEMENTS = 16;
const COLOUR = '#0072b2';
const WHOLE = [1, 2, 5].flatMap((digit) => [0, 1, 2, 3, 4, 5, 6, 7, 8].map((power) => digit * 10 ** power)).sort((a, b) => a - b);
/** Returns the name of an element of the observation, or its index. */
const elementName = ({name}, index) => name || `${index}`;
const CHARTS = [
  {title: 'Return of an episode, by episode', format: (y) => fixed(y), points: ({episodes}) =>
    episodes.map(({first, count: n, mean_return: y}) => [first + n - 1, y])},
  {title: 'Spikes per decision, by decision', format: (y) => si(y), points: ({decisions}) =>
    decisions.map(({first, count: n, spikes_per_decision: y}) => [first + n, y])},
  {title: 'Time of a decision, by decision', format: (y) => si(y, 's'), points: ({decisions}) =>
    decisions.map(({first, count: n, mean_seconds: y}) => [first + n, y])},
  {title: 'Decisions per second, by decision', format: (y) => si(y), points: ({decisions}) =>
    decisions.map(({first, count: n, until_seconds: end}, i) => {
      const seconds = end - (decisions[i - 1]?.until_seconds ?? 0);
      return [first + n, seconds > 0 ? n / seconds : null];
    })},
];

function pressed(button) {
  return button.getAttribute('aria-pressed') === 'true';
}

/** Returns the tiles about a person's help: that which the robot needs, and what it has learned from operators. */
function helpTiles(session) {
  const {corrections, needs_help: need} = session;
  const [score, reasons] = needOf(session);
  return [
    ...(need ? [{label: 'Needs help', value: score, note: reasons}] : []),
    ...(corrections ? [{label: 'Corrections', value: count(Number(corrections.steps)),
      note: `apart ${fixed(corrections.disagreement, 2)}, before ${fixed(corrections.start_disagreement, 2)}`}] : []),
  ];
}

export class SessionView {
  constructor() {
    const get = (id) => document.getElementById(id);
    this.section = get('session');
    this.error = get('session-error');
    this.tiles = new TileGrid(get('session-tiles'));
    this.chartBox = get('session-charts');
    this.body = get('decision');
    this.scene = new Scene(get('scene'));
    this.seat = new Seat();
    this.undo = new Undo();
    this.observation = get('observation');
    this.liveState = get('live-state');
    this.decisionError = get('decision-error');
    this.token = get('token');
    this.frame = get('frame');
    this.frameText = get('frame-text');
    this.followButton = get('follow');
    this.playButton = get('play');
    this.frames = [];  // explanations of the last decisions, oldest first
    this.token.addEventListener('change', () => this.draw());
    this.frame.addEventListener('input', () => {
      this.setFollowing(false);
      this.draw();
    });
    this.followButton.addEventListener('click', () => this.setFollowing(!pressed(this.followButton)));
    document.addEventListener('visibilitychange', () => this.watch());
    this.playButton.addEventListener('click', () => this.play(!pressed(this.playButton)));
    const rebuild = () => {
      this.plots = undefined;
      if (this.shown) this.showFigures(this.shown);
      this.draw();
    };
    matchMedia('(prefers-color-scheme: dark)').addEventListener('change', rebuild);
    addEventListener('resize', rebuild);
  }

  /** Selects a session; undefined selects none. */
  open(id) {
    if (id === this.id) return;
    this.id = id;
    this.seat.open(id);
    this.undo.open();
    this.frames = [];
    this.shown = undefined;
    this.live = undefined;
    this.refused = undefined;
    this.play(false);
    for (const text of [this.error, this.decisionError, this.frameText, this.liveState]) setText(text, '');
    this.body.replaceChildren();
    this.observation.replaceChildren();
    this.scene.clear();
    this.setFollowing(true);
    if (!id) return;
    this.section.focus({preventScroll: true});
    this.refresh().catch(() => {});  // the next turn of the page shows a problem that lasts
  }

  async refresh() {
    const {id} = this;
    let session;
    try {
      session = await fetchJson('session.json', {session: id});
    } catch (error) {
      setText(this.error, error.message);
      return;
    }
    if (this.id !== id) return;
    setText(this.error, '');
    this.seat.show(session);
    this.undo.show(session);
    this.showFigures(session);
    const asks = !this.streams() || this.frames.length === 0;  // also for what cannot be explained
    if (pressed(this.followButton) && asks) await this.fetchFrame(id);
  }

  /** Returns whether the server sends the decisions by itself. */
  streams() {
    return this.source !== undefined && this.source.readyState !== EventSource.CLOSED;
  }

  /** Listens to the decisions of the session while somebody follows them, and at no other time. */
  watch() {
    this.source?.close();
    this.source = undefined;
    if (!this.id || !pressed(this.followButton) || document.hidden || this.refused === this.id) return;
    const {id} = this;
    const source = new EventSource(`watch?session=${encodeURIComponent(id)}`);
    const on = (name, take) => source.addEventListener(name, ({data}) => {
      if (this.source === source) take(JSON.parse(data));
    });
    on('decision', (decision) => {
      this.live = decision;
      setText(this.liveState, 'Live: each decision as the server makes it, at most 20 a second.');
      this.drawScene();
    });
    on('explanation', (decision) => this.addFrame(decision));
    on('end', ({message}) => {
      this.refused = id;
      source.close();
      setText(this.liveState, `The session has ended: ${message}`);
    });
    source.addEventListener('error', () => {
      if (this.source !== source || source.readyState !== EventSource.CLOSED) return;  // the browser tries again
      this.refused = id;  // as many watch as may
      setText(this.liveState, 'The server has no room for another watcher: the page asks once a second.');
    });
    this.source = source;
  }

  showFigures(session) {
    const isFirst = !this.shown;
    this.shown = session;
    if (isFirst) this.drawScene();
    const decisions = Number(session.decisions);
    if (!this.live && this.frames.length === 0) this.showObservation(session.observation);
    const labels = Object.entries(session.labels).map(([key, value]) => `${key}=${value}`).join(' ');
    const {history} = session;
    const seconds = history.decisions.reduce((sum, point) => sum + point.count * point.mean_seconds, 0);
    const [energy, model] = energyOf(session);
    const counted = history.decisions.reduce((sum, point) => sum + point.count, 0);
    this.tiles.show([
      {label: nameOf(session), value: `${session.policy}/${session.version}`,
       note: session.hold !== null ? `HELD by ${session.hold}` : labels || 'no labels'},
      {label: 'Mean return', value: fixed(session.mean_return ?? undefined),
       note: `${count(session.ended_episodes)} episodes`},
      {label: 'Last return', value: fixed(session.last_return ?? undefined),
       note: `target ${fixed(session.target_return)}`},
      {label: 'Return so far', value: fixed(session.episode_return),
       note: `step ${session.step}, no. ${session.episode}`},
      {label: 'Decisions', value: count(decisions),
       note: `idle for ${duration(session.idle_seconds)}, by ${session.transport}, last executed: ${session.last_source ?? NOTHING}`},
      {label: 'Spikes / decision', value: decisions ? fixed(Number(session.spikes) / decisions) : NOTHING,
       note: `${count(Number(session.spikes))} spikes`},
      {label: 'Time of a decision', value: si(counted ? seconds / counted : undefined, 's'), note: 'mean'},
      {label: 'Energy of a decision', value: energy, note: model},
      ...helpTiles(session),
    ]);
    if (!this.plots) {
      this.chartBox.replaceChildren();
      const range = (_, low, high) => [low ?? 0, Math.max(high ?? 1, (low ?? 0) + 1)];
      this.plots = CHARTS.map(({title, format}) =>
        makeChart(this.chartBox, title, [{label: title, colour: COLOUR}], (x) => si(x), format, range, WHOLE));
    }
    CHARTS.forEach(({points}, i) => {
      const list = points(history);
      this.plots[i].setData([list.map(([x]) => x), list.map(([, y]) => y)]);
    });
  }

  /** Shows the verdict about the wiring, and each element of the last observation against its range in training. */
  showObservation(elements) {
    if (!elements.length) return;
    const far = elements.flatMap(({unusual}, i) => (unusual ? [i] : []));
    const verdict = far.length === 0
      ? 'Every element is as in training.'
      : `Element${far.length === 1 ? '' : 's'} ${far.map((i) => elementName(elements[i], i)).join(', ')}: ` +
        'unlike anything in training.';
    const wiring = this.shown?.wiring;
    this.observation.replaceChildren(element('figure', {},
      element('figcaption', {textContent: 'Last observation against training'}),
      ...elements.slice(0, SHOWN_ELEMENTS).map((part, i) => rangeRow(elementName(part, i), part)),
      ...(wiring ? [element('p', {className: 'bad', textContent: `Miswired? ${wiring}.`})] : []),
      element('p', {className: far.length ? 'bad' : 'quiet', textContent: verdict}),
      element('p', {className: 'quiet', textContent: 'Shaded: two standard deviations around the mean of the training data.' +
        (elements.length > SHOWN_ELEMENTS ? ` The first ${SHOWN_ELEMENTS} of ${elements.length} elements.` : '')})));
  }

  async fetchFrame(id) {
    let decision;
    try {
      decision = await fetchJson('explain.json', {session: id});
    } catch (error) {
      if (this.id === id) setText(this.decisionError, error.message);
      return;
    }
    if (this.id === id && pressed(this.followButton)) this.addFrame(decision);
  }

  addFrame(decision) {
    setText(this.decisionError, '');
    const last = this.frames[this.frames.length - 1];
    if (last && last.episode === decision.episode && last.answer.step === decision.answer.step) return;
    this.frames.push(decision);
    if (this.frames.length > KEPT_DECISIONS) this.frames.shift();
    this.frame.max = this.frames.length - 1;
    if (!pressed(this.playButton)) this.frame.value = this.frame.max;
    this.draw();
  }

  setFollowing(on) {
    this.followButton.setAttribute('aria-pressed', String(on));
    this.live = undefined;
    this.watch();
  }

  /** Shows the decisions that the page has one after the other, from the first one if the last one is shown. */
  play(on) {
    clearInterval(this.timer);
    this.playButton.setAttribute('aria-pressed', String(on));
    if (!on) return;
    if (this.frame.value === this.frame.max) this.frame.value = 0;
    this.draw();
    this.timer = setInterval(() => {
      this.frame.value = Number(this.frame.value) + 1;
      this.draw();
      if (this.frame.value === this.frame.max) this.play(false);
    }, PLAY_MILLISECONDS);
  }

  draw() {
    const decision = this.frames[Number(this.frame.value)];
    if (!decision) return;
    setText(this.frameText, `${Number(this.frame.value) + 1} of ${this.frames.length}: ` +
      `episode ${decision.episode}, step ${decision.answer.step}`);
    drawDecision(this.body, decision, this.token.value);
    this.drawScene();
  }

  /** Draws the newest decision while the page follows, and otherwise the selected one. */
  drawScene() {
    const playing = pressed(this.playButton);
    const decision = (!playing && this.live) || this.frames[Number(this.frame.value)];
    if (!decision || !this.shown) return;  // the session says which task it is
    this.scene.show(decision, this.shown.environment);
    const ranges = this.shown.observation;
    if (ranges.length !== decision.observation.length) return;
    this.showObservation(ranges.map((range, i) => {
      const value = decision.observation[i];
      return {...range, value, unusual: range.low !== null && !(value >= range.low && value <= range.high)};
    }));
  }
}
