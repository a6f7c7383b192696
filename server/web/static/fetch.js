// Fetches the JSON documents of the server.

/** Returns the document at `path`. Throws an Error with the message of the server. */
export async function fetchJson(path, parameters = {}) {
  const query = new URLSearchParams(parameters).toString();
  const response = await fetch(query ? `${path}?${query}` : path);
  const answer = await response.json();
  if (!response.ok) throw new Error(answer.message);
  return answer;
}
