// Calls the engine in WebAssembly (client/playground/exports.cc). It plays one policy at a time.
import createModule from './spikeserve.js';

const module = await createModule();

function parse(text) {
  const answer = JSON.parse(module.UTF8ToString(text));
  if (answer.error !== undefined) throw new Error(answer.error);
  return answer;
}

/** Opens a policy file, a Uint8Array, in its environment, which begins as Gymnasium's reset(seed). */
export function open(file, seed) {
  const copy = module._malloc(file.length);
  module.HEAPU8.set(file, copy);
  try {
    parse(module._playground_open(copy, file.length, seed));
  } finally {
    module._free(copy);
  }
}

/** Decides once, takes the action and returns the decision (client/playground/playground.h). */
export const step = () => parse(module._playground_step());

/** Returns the last decision with its spikes, gates and attention. */
export const explain = () => parse(module._playground_explain());
