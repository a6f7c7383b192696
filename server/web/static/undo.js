// Takes out of a head what an operator has taught, by two presses of one button.
import {postJson} from './fetch.js';
import {count, fixed, setText} from './format.js';

const CONFIRMATION_SECONDS = 5;  // between the two presses, at most

const get = (id) => document.getElementById(id);

export class Undo {
  constructor() {
    this.button = get('undo-button');
    this.name = get('undo-name');
    this.minutes = get('undo-minutes');
    this.button.addEventListener('click', () => (this.isAsked ? this.undo() : this.ask()));
    for (const input of [this.name, this.minutes]) input.addEventListener('input', () => this.forget());
    this.button.addEventListener('blur', () => this.forget());
  }

  /** Selects another session, or none. */
  open() {
    this.session = undefined;
    this.forget();
    get('undo').hidden = true;
    this.name.value = '';
    for (const part of ['undo-state', 'undo-error']) setText(get(part), '');
  }

  /** Offers it for a session that operators have corrected. */
  show(session) {
    this.session = session;
    get('undo').hidden = !session.corrections;
    if (session.operator_id && document.activeElement !== this.name) this.name.value ||= session.operator_id;
  }

  ask() {
    this.isAsked = true;
    setText(get('undo-error'), '');
    setText(get('undo-state'), this.session.learns === 'fleet' ? 'Of the whole fleet.' : '');
    setText(this.button, 'Press again to undo');
    this.timer = setTimeout(() => this.forget(), 1000 * CONFIRMATION_SECONDS);
  }

  forget() {
    clearTimeout(this.timer);
    if (this.isAsked) setText(get('undo-state'), '');
    this.isAsked = false;
    setText(this.button, 'Undo');
  }

  async undo() {
    this.forget();
    const {session} = this;
    const {session_id, policy, version, tenant, learns} = session;
    const head = learns === 'fleet' ? {policy, version, tenant} : {session_id};
    let undone;
    try {
      undone = await postJson('undo.json', {...head, operator_id: this.name.value, seconds: 60 * this.minutes.value});
    } catch (error) {
      if (this.session?.session_id === session_id) setText(get('undo-error'), `Nothing was undone. ${error.message}`);
      return;
    }
    if (this.session?.session_id !== session_id) return;
    setText(get('undo-state'), `${count(Number(undone.updates))} updates undone; the head is ${
      fixed(100 * undone.head_drift, 1)} % from the policy's.`);
  }
}
