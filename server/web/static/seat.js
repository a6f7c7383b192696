// The operator's seat: takes control of the session that the page shows, and steers it with keys, the mouse or a gamepad.
// The lease is renewed while the page is visible and has the focus, and given back otherwise.
import {postJson} from './fetch.js';
import {element, fixed, percent, setText} from './format.js';

const LEASE_SECONDS = 1;
const RENEWAL_MILLISECONDS = 250;
const ATTENTION_SECONDS = 30;  // without a key, a click or a gamepad that is in use, at most
const SENDING_MILLISECONDS = 50;  // between two actions, at least
const NAME = 'spikeserve-operator';
// Of a Box, as in spikectl take: the keys that lower and raise each of the first axes.
const LOWER = 'asjk';
const RAISE = 'dwli';
const STEP = 0.1;  // of an axis, as a share of its range
const STILL = 0.1;  // a stick nearer to its middle is in its middle
const MOST_ACTIONS = 32;  // that have a button
// The lease goes on although these have happened.
const PASSING = new Set([undefined, 'RESOURCE_EXHAUSTED', 'UNAVAILABLE', 'DEADLINE_EXCEEDED']);

const get = (id) => document.getElementById(id);
const clamp = (x, low, high) => Math.min(Math.max(x, low), high);
const sleep = (milliseconds) => new Promise((done) => setTimeout(done, milliseconds));

/** Returns the axes that can be steered, at most four: {low, high} of each. */
function axesOf({box}) {
  return box ? box.low.slice(0, LOWER.length).map((low, i) => ({low, high: box.high[i]})) : [];
}

export class Seat {
  constructor() {
    this.button = get('seat-button');
    this.actions = get('seat-actions');
    this.name = get('seat-name');
    this.name.value = localStorage.getItem(NAME) ?? '';
    this.button.addEventListener('click', () => (this.lease ? this.leave('You returned the session to its policy.') : this.take()));
    document.addEventListener('keydown', (event) => this.press(event));
    document.addEventListener('visibilitychange', () => document.hidden && this.leave('The page was hidden, so the policy acts again.'));
    addEventListener('blur', () => this.leave('The page lost the focus, so the policy acts again.'));
    addEventListener('pagehide', () => this.leave(''));
  }

  /** Selects a session; undefined selects none. */
  open(id) {
    this.leave('');
    this.id = id;
    this.holder = '';
    for (const part of ['seat-state', 'seat-agreement', 'seat-error', 'seat-keys']) setText(get(part), '');
  }

  /** Shows who has control. */
  show({operator_id: holder, hold}) {
    if (!this.lease) {
      this.holder = holder;
      if (holder) setText(get('seat-state'), `${holder} has control.`);
      else if (get('seat-state').textContent.endsWith('has control.')) setText(get('seat-state'), '');
      setText(this.button, holder ? `Take over from ${holder}` : 'Take control');
    }
    if (hold !== null && !this.lease) setText(get('seat-agreement'), `Held by ${hold}: no operator is heard.`);
    else if (!this.lease) setText(get('seat-agreement'), '');
  }

  async take() {
    const {id} = this;
    localStorage.setItem(NAME, this.name.value);
    setText(get('seat-error'), '');
    let taken;
    try {
      taken = await postJson('take.json', {session_id: id, operator_id: this.name.value, lease_seconds: LEASE_SECONDS,
                                           take_over: this.holder !== ''});
    } catch (error) {
      setText(get('seat-error'), `You do not have control. ${error.message}`);
      return;
    }
    this.lease = {session_id: id, lease_id: taken.lease_id};
    if (this.id !== id || !this.isAttended()) {
      this.leave('The page lost the focus, so the policy acts again.');
      return;
    }
    this.heard = performance.now();
    this.space = taken.action_space;
    this.first = taken.action;
    this.pads = new Map();
    this.offer();
    this.choose(taken.action);
    const relieved = taken.relieved_operator_id;
    setText(get('seat-state'), `${taken.operator_id}, you have control${relieved ? `; ${relieved} is relieved` : ''}.`);
    setText(this.button, 'Return to the policy');
    this.actions.focus();
    this.timer = setInterval(() => this.send(), RENEWAL_MILLISECONDS);
    this.readPads();
  }

  isAttended() {
    return !document.hidden && document.hasFocus();
  }

  /** Gives the session back, and says why. */
  leave(reason) {
    const {lease} = this;
    if (!lease) return;
    this.end(reason);
    postJson('return.json', lease, true).catch(() => {});  // the lease ends by itself
  }

  end(reason) {
    this.lease = undefined;
    clearInterval(this.timer);
    this.actions.hidden = true;
    if (document.activeElement === this.actions || this.actions.contains(document.activeElement)) this.button.focus();
    setText(get('seat-keys'), '');
    setText(get('seat-state'), reason);
    setText(this.button, 'Take control');
    this.holder = '';
  }

  /** Makes the controls of the action space. */
  offer() {
    const {discrete} = this.space;
    const axes = axesOf(this.space);
    this.controls = discrete
      ? Array.from({length: Math.min(Number(discrete.n), MOST_ACTIONS)}, (_, i) => {
        const button = element('button', {type: 'button', textContent: `action ${i}`});
        button.addEventListener('click', () => this.choose({discrete: i}));
        return button;
      })
      : axes.map(({low, high}, i) => {
        const slider = element('input', {type: 'range', min: low, max: high, step: 'any', ariaLabel: `axis ${i}`});
        slider.addEventListener('input', () => this.setAxis(i, Number(slider.value)));
        return slider;
      });
    this.outputs = axes.map(() => element('output'));
    this.actions.replaceChildren(...(discrete ? this.controls
      : this.controls.map((slider, i) => element('label', {}, `axis ${i} `, slider, this.outputs[i]))));
    this.actions.hidden = false;
    const keys = discrete ? `0 to ${Math.min(Number(discrete.n), 10) - 1}: the action`
                          : axes.map((_, i) => `${LOWER[i]} and ${RAISE[i]}: axis ${i}`).join(', ');
    setText(get('seat-keys'), `Keys ${keys}; space: the first action again; q: return to the policy. A gamepad: ${
      discrete ? 'button n is action n, the stick to the left the first one, to the right the last one'
               : 'the sticks, in the order of their axes'}.`);
  }

  choose(action) {
    this.action = action;
    const {discrete, continuous} = action;
    this.active = performance.now();
    this.controls.forEach((control, i) => {
      if (!continuous) {
        control.setAttribute('aria-pressed', String(i === Number(discrete)));
        return;
      }
      control.value = continuous.values[i];
      setText(this.outputs[i], fixed(continuous.values[i], 3));
    });
    this.isNew = true;
    this.send();
  }

  setAxis(i, value) {
    const values = [...this.action.continuous.values];
    values[i] = clamp(value, this.space.box.low[i], this.space.box.high[i]);
    this.choose({continuous: {values}});
  }

  press(event) {
    const {key, target} = event;
    if (!this.lease || event.ctrlKey || event.altKey || event.metaKey || target.matches('input:not([type=range]), select')) return;
    this.active = performance.now();  // also by a key without a meaning
    const axes = axesOf(this.space);
    const lower = LOWER.indexOf(key);
    const axis = Math.max(lower, RAISE.indexOf(key));
    if (key === 'q' || key === 'Escape') {
      this.leave('You returned the session to its policy.');
    } else if (key === ' ' && !target.matches('button, summary')) {
      this.choose(this.first);
    } else if (this.space.discrete && /^[0-9]$/.test(key) && Number(key) < Number(this.space.discrete.n)) {
      this.choose({discrete: Number(key)});
    } else if (axis in axes) {
      const {low, high} = axes[axis];
      this.setAxis(axis, this.action.continuous.values[axis] + (lower === axis ? -STEP : STEP) * (high - low));
    } else {
      return;
    }
    event.preventDefault();
  }

  /** Takes what the gamepads do, once for each picture of the screen. */
  readPads() {
    if (!this.lease) return;
    for (const pad of navigator.getGamepads().filter(Boolean)) {
      const axes = pad.axes.slice(0, LOWER.length).map((x) => (Math.abs(x) < STILL ? 0 : x));
      const pressed = pad.buttons.findIndex((button) => button.pressed);
      const state = JSON.stringify([axes, pressed]);
      if (pressed >= 0 || axes.some((x) => x !== 0)) this.active = performance.now();
      const before = this.pads.get(pad.index);
      this.pads.set(pad.index, state);
      // One that lies still leaves the keys alone.
      if (before !== undefined && before !== state) this.takePad(axes, pressed);
    }
    requestAnimationFrame(() => this.readPads());
  }

  takePad(axes, pressed) {
    const {discrete, box} = this.space;
    if (discrete) {
      const last = Number(discrete.n) - 1;
      if (pressed >= 0 && pressed <= last) this.choose({discrete: pressed});
      else if (Math.abs(axes[0]) > 0.5) this.choose({discrete: axes[0] < 0 ? 0 : last});
      return;
    }
    const values = this.action.continuous.values.map((value, i) => {
      if (i >= axes.length) return value;
      const [low, high] = [box.low[i], box.high[i]];
      const x = i % 2 === 1 ? -axes[i] : axes[i];  // a gamepad counts downwards
      return clamp((low + high) / 2 + x * (high - low) / 2, low, high);
    });
    this.choose({continuous: {values}});
  }

  /** Sends the newest action, or renews the lease: one call at a time, so that the newest action never waits in a queue. */
  async send() {
    const {lease} = this;
    if (!lease || this.isSending) return;
    if (!this.isAttended()) {
      this.leave('The page lost the focus, so the policy acts again.');
      return;
    }
    if (performance.now() - this.active > 1000 * ATTENTION_SECONDS) {
      this.leave(`You did nothing for ${ATTENTION_SECONDS} s, so the policy acts again.`);
      return;
    }
    this.isSending = true;
    const began = performance.now();
    const message = this.isNew ? {...lease, action: this.action} : lease;
    this.isNew = false;
    try {
      const answer = await postJson('steer.json', message);
      this.heard = began;
      if (this.lease === lease) this.showAgreement(answer);
    } catch (error) {
      this.isNew ||= 'action' in message;
      if (this.lease === lease) this.onError(error);
    }
    await sleep(SENDING_MILLISECONDS - (performance.now() - began));
    this.isSending = false;
    if (this.isNew) this.send();
  }

  onError(error) {
    const isOver = performance.now() - this.heard > 1000 * LEASE_SECONDS;
    if (PASSING.has(error.code) && !isOver) return;
    this.end('');
    setText(get('seat-error'), `You no longer have control. ${error.message}`);
  }

  showAgreement({steps, agreed_steps: agreed, hold}) {
    const share = steps > 0 ? ` (${percent(agreed / steps)})` : '';
    setText(get('seat-agreement'), hold
      ? `Held by ${hold.id}: ${hold.reason || 'no reason'}. You are not heard.`
      : `The policy agreed in ${agreed} of ${steps} steps${share}.`);
  }
}
