// Fetches the JSON documents of the server, and calls its methods.

async function answerOf(request) {
  const response = await request;
  const text = await response.text();
  if (response.ok) return JSON.parse(text);
  const {code, message, error} = text.startsWith('{') ? JSON.parse(text) : {message: text.trim()};
  throw Object.assign(new Error(message ?? error), {code});
}

/** Returns the document at `path`. Throws an Error with the message of the server, and the name of its `code`. */
export function fetchJson(path, parameters = {}) {
  const query = new URLSearchParams(parameters).toString();
  return answerOf(fetch(query ? `${path}?${query}` : path));
}

/** Sends a message to `path`, and returns the answer. Errors as fetchJson. `keepalive`: also while the page goes away. */
export function postJson(path, message, keepalive = false) {
  const headers = {'Content-Type': 'application/json'};
  return answerOf(fetch(path, {method: 'POST', headers, body: JSON.stringify(message), keepalive}));
}
