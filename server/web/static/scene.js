// Draws the task of a session from an observation: cart and pole, pendulum, hill, lander. Tasks that it does not know
// become traces of the elements of their last observations.
import {element, fixed} from './format.js';

const WIDTH = 720;  // pixels of the canvas; the page shows them at half the size or less
const HEIGHT = 480;
const KEPT = 120;  // observations in a trace

/** A place to draw in world coordinates: x to the right, y upwards, `unit` pixels for 1, the origin at (x0, y0) pixels. */
class World {
  constructor(context, x0, y0, unit, colours) {
    Object.assign(this, {context, x0, y0, unit, colours});
  }

  at(x, y) {
    return [this.x0 + x * this.unit, this.y0 - y * this.unit];
  }

  line(points, colour, width) {
    const {context} = this;
    context.strokeStyle = colour;
    context.lineWidth = width;
    context.lineCap = context.lineJoin = 'round';
    context.beginPath();
    points.forEach(([x, y], i) => context[i ? 'lineTo' : 'moveTo'](...this.at(x, y)));
    context.stroke();
  }

  fill(points, colour) {
    const {context} = this;
    context.fillStyle = colour;
    context.beginPath();
    points.forEach(([x, y], i) => context[i ? 'lineTo' : 'moveTo'](...this.at(x, y)));
    context.closePath();
    context.fill();
  }

  disc(x, y, pixels, colour) {
    const {context} = this;
    context.fillStyle = colour;
    context.beginPath();
    context.arc(...this.at(x, y), pixels, 0, 2 * Math.PI);
    context.fill();
  }

  /** An arrow from (x, y) along the x axis, `length` long and pointing to the left if it is negative. */
  arrow(x, y, length) {
    if (Math.abs(length) * this.unit < 8) return;
    const head = Math.sign(length) * 14 / this.unit;
    this.line([[x, y], [x + length, y]], this.colours.action, 6);
    this.line([[x + length - head, y + Math.abs(head) * 0.7], [x + length, y], [x + length - head, y - Math.abs(head) * 0.7]],
              this.colours.action, 6);
  }
}

const clamp = (x, low, high) => Math.min(high, Math.max(low, x));

/** Returns the end of a rod from (x, y) at `angle` from the upright, clockwise. */
const rodEnd = ([x, y], length, angle) => [x + length * Math.sin(angle), y + length * Math.cos(angle)];

function cartAndPoles(context, colours, x, angles, push, {half, unit, pole}) {
  const world = new World(context, WIDTH / 2, HEIGHT * 0.72, unit, colours);
  const [wide, high] = [46 / unit, 26 / unit];
  world.line([[-half, 0], [half, 0]], colours.line, 4);
  for (const end of [-half, half]) world.line([[end, -0.04 * half], [end, 0.04 * half]], colours.line, 4);
  const cart = clamp(x, -half, half);
  world.fill([[cart - wide, -high], [cart + wide, -high], [cart + wide, high], [cart - wide, high]], colours.ink);
  let joint = [cart, high * 0.4];
  for (const angle of angles) {
    const end = rodEnd(joint, pole, angle);
    world.line([joint, end], colours.body, 14);
    world.disc(...joint, 9, colours.ground);
    joint = end;
  }
  world.arrow(cart + Math.sign(push) * wide * 1.3, -high * 2.6, push);
}

function cartPole(context, colours, [x, second, third], action, n) {
  const angle = n === 2 ? second : third;
  cartAndPoles(context, colours, x, [angle], action === 1 ? 0.5 : -0.5, {half: 2.4, unit: 138, pole: 1.8});
}

function doublePendulum(context, colours, [x, sin1, sin2, cos1, cos2], action) {
  // Both angles are of the hinges: the second is relative to the first rod.
  const first = Math.atan2(sin1, cos1);
  const second = first + Math.atan2(sin2, cos2);
  cartAndPoles(context, colours, x, [first, second], 0.3 * (action?.[0] ?? 0), {half: 1, unit: 280, pole: 0.5});
}

function pendulum(context, colours, [cos, sin], action) {
  const world = new World(context, WIDTH / 2, HEIGHT / 2, 190, colours);
  // Gymnasium counts the angle counterclockwise from the upright.
  const end = rodEnd([0, 0], 1, -Math.atan2(sin, cos));
  world.line([[0, 0], end], colours.body, 26);
  world.disc(0, 0, 9, colours.ink);
  world.disc(...end, 13, colours.body);
  world.arrow(0, -1.1, -0.4 * (action?.[0] ?? 0));  // a positive torque turns the top to the left
}

function acrobot(context, colours, [cos1, sin1, cos2, sin2], action) {
  const world = new World(context, WIDTH / 2, HEIGHT * 0.52, 105, colours);
  const first = Math.atan2(sin1, cos1);
  const second = first + Math.atan2(sin2, cos2);
  const down = ([x, y], angle) => [x + Math.sin(angle), y - Math.cos(angle)];
  const elbow = down([0, 0], first);
  const tip = down(elbow, second);
  world.line([[-2.2, 1], [2.2, 1]], colours.line, 3);  // which the tip must reach
  world.line([[0, 0], elbow], colours.ink, 16);
  world.line([elbow, tip], colours.body, 16);
  world.disc(0, 0, 8, colours.ground);
  world.disc(...elbow, 8, colours.ground);
  world.arrow(0, -2.15, 0.5 * ((action ?? 1) - 1));
}

function hill(context, colours, [position], action) {
  const world = new World(context, WIDTH / 2 + 0.3 * 365, HEIGHT * 0.94, 365, colours);
  const height = (x) => 0.45 * Math.sin(3 * x) + 0.55;
  const ground = Array.from({length: 91}, (_, i) => -1.2 + i * 0.02);
  world.fill([...ground.map((x) => [x, height(x)]), [0.6, -1], [-1.2, -1]], colours.grid);
  world.line(ground.map((x) => [x, height(x)]), colours.line, 4);
  world.line([[0.5, height(0.5)], [0.5, height(0.5) + 0.13]], colours.ink, 4);
  world.fill([[0.5, height(0.5) + 0.13], [0.42, height(0.5) + 0.1], [0.5, height(0.5) + 0.07]], colours.action);
  const slope = Math.atan(1.35 * Math.cos(3 * position));
  const centre = [position - 0.05 * Math.sin(slope), height(position) + 0.05 * Math.cos(slope)];
  const corner = (along, up) => [centre[0] + along * Math.cos(slope) - up * Math.sin(slope),
                                 centre[1] + along * Math.sin(slope) + up * Math.cos(slope)];
  world.fill([corner(-0.07, -0.02), corner(0.07, -0.02), corner(0.07, 0.035), corner(-0.07, 0.035)], colours.body);
  for (const along of [-0.04, 0.04]) world.disc(...corner(along, -0.03), 9, colours.ink);
  world.arrow(centre[0] + 0.09 * ((action ?? 1) - 1), centre[1] + 0.1, 0.14 * ((action ?? 1) - 1));
}

function lander(context, colours, [x, y, , , angle, , left, right], action) {
  const world = new World(context, WIDTH / 2, HEIGHT * 0.86, 250, colours);
  world.fill([[-2, 0], [2, 0], [2, -1], [-2, -1]], colours.grid);
  world.line([[-2, 0], [2, 0]], colours.line, 4);
  for (const flag of [-0.2, 0.2]) {
    world.line([[flag, 0], [flag, 0.14]], colours.ink, 4);
    world.fill([[flag, 0.14], [flag + 0.08, 0.11], [flag, 0.08]], colours.action);
  }
  const centre = [clamp(x, -1.35, 1.35), clamp(y, -0.1, 1.6) + 0.1];
  // Gymnasium counts the angle counterclockwise.
  const at = (along, up) => [centre[0] + along * Math.cos(angle) - up * Math.sin(angle),
                             centre[1] + along * Math.sin(angle) + up * Math.cos(angle)];
  const flame = {1: [at(-0.1, 0.03), at(-0.24, 0.03)], 2: [at(0, -0.07), at(0, -0.24)], 3: [at(0.1, 0.03), at(0.24, 0.03)]}[action];
  if (flame) world.line(flame, colours.action, 12);
  for (const [side, touches] of [[-1, left], [1, right]]) {
    world.line([at(side * 0.07, -0.03), at(side * 0.13, -0.1)], touches > 0.5 ? colours.action : colours.ink, 7);
  }
  world.fill([at(-0.09, -0.06), at(0.09, -0.06), at(0.06, 0.08), at(-0.06, 0.08)], colours.body);
}

const TASKS = [
  {name: /CartPole/, sizes: [2, 4], draw: cartPole, what: 'cart and pole'},
  {name: /InvertedDoublePendulum/, sizes: [9, 11], draw: doublePendulum, what: 'cart with two poles'},
  {name: /^(PositionOnly|Late)?Pendulum/, sizes: [2, 3], draw: pendulum, what: 'pendulum'},
  {name: /Acrobot/, sizes: [4, 6], draw: acrobot, what: 'acrobot'},
  {name: /MountainCar-/, sizes: [1, 2], draw: hill, what: 'car on a hill'},
  {name: /LunarLander-/, sizes: [8], draw: lander, what: 'lander'},
];

/** Draws a line for each element of the last observations, each in a band of its own, scaled to its own range. */
function traces(context, colours, history) {
  const size = history[0].length;
  const shown = Math.min(size, 12);
  const band = HEIGHT / shown;
  for (let i = 0; i < shown; ++i) {
    const values = history.map((observation) => observation[i]);
    const low = Math.min(...values);
    const range = Math.max(...values) - low || 1;
    context.fillStyle = colours.line;
    context.fillRect(0, (i + 1) * band - 1, WIDTH, 2);
    context.strokeStyle = colours.body;
    context.lineWidth = 4;
    context.beginPath();
    values.forEach((value, j) => context[j ? 'lineTo' : 'moveTo'](
      (KEPT - values.length + j + 1) / KEPT * (WIDTH - 8), (i + 1) * band - 8 - (value - low) / range * (band - 16)));
    context.stroke();
  }
  return shown < size ? `the first ${shown} of ${size} elements` : `${size} elements`;
}

/** A figure of the task. */
export class Scene {
  constructor(target) {
    this.canvas = element('canvas', {className: 'map', width: WIDTH, height: HEIGHT});
    this.canvas.setAttribute('role', 'img');
    this.title = element('figcaption');
    this.note = element('p', {className: 'quiet'});
    this.figure = element('figure', {}, this.title, this.canvas, this.note);
    target.replaceChildren(this.figure);
    this.clear();
  }

  clear() {
    this.history = [];  // observations of decisions, oldest first
    this.figure.hidden = true;
  }

  /** Draws a decision, an ExplainResponse; `environment` is Gymnasium's name. */
  show(decision, environment) {
    const {observation, answer} = decision;
    this.history = [...this.history.slice(1 - KEPT), observation].filter(({length}) => length === observation.length);
    const action = answer.action.continuous?.values ?? Number(answer.action.discrete);
    const style = getComputedStyle(document.documentElement);
    const colour = (name) => style.getPropertyValue(name);
    const colours = {ground: colour('--ground'), ink: colour('--ink'), line: colour('--quiet'), grid: colour('--grid'),
                     body: colour('--spike'), action: colour('--action')};
    const context = this.canvas.getContext('2d');
    context.fillStyle = colours.ground;
    context.fillRect(0, 0, WIDTH, HEIGHT);
    const task = TASKS.find(({name, sizes}) => name.test(environment) && sizes.includes(observation.length));
    let what = task?.what;
    if (task) task.draw(context, colours, observation, action, observation.length);
    else what = `traces of ${traces(context, colours, this.history)}`;
    const chosen = Array.isArray(action) ? action.map((x) => fixed(x, 2)).join(', ') : action;
    this.figure.hidden = false;
    this.title.textContent = `${environment || 'Observation'}: ${what}`;
    this.canvas.setAttribute('aria-label', `${what} at step ${answer.step} of episode ${decision.episode}`);
    this.note.textContent = `Episode ${decision.episode}, step ${answer.step}, action ${chosen}, ` +
      `${answer.stats.spikes} spikes.`;
  }
}
