// The service's REST interface, and the live events of a tuning.

const TOKEN = "autotuner-token";

/** What the service refused: a problem (RFC 9457). */
export class Problem extends Error {
  constructor(members) {
    super(members.detail || members.title);
    Object.assign(this, members);
  }
}

let askForToken = null;

/** Say what shows the form for a token; it is told whether one was refused, and returns a promise of the token. */
export function onTokenWanted(ask) {
  askForToken = ask;
}

function headers(more = {}) {
  const token = sessionStorage.getItem(TOKEN);
  return token ? { ...more, Authorization: `Bearer ${token}` } : more;
}

async function send(path, options = {}) {
  let answer;
  try {
    answer = await fetch(path, { cache: "no-store", ...options, headers: headers(options.headers) });
  } catch (error) {
    if (error.name === "AbortError") throw error;
    throw new Problem({ title: "The service does not answer", detail: "The page cannot reach the service.", remedy: "Check that it runs; this page goes on by itself.", status: 0 });
  }
  if (answer.status === 401 && askForToken) {
    sessionStorage.setItem(TOKEN, await askForToken(Boolean(sessionStorage.getItem(TOKEN))));
    return send(path, options);
  }
  if (answer.status >= 400) {
    const members = await answer.json().catch(() => ({ title: answer.statusText, detail: `Status ${answer.status}`, status: answer.status }));
    throw new Problem(members);
  }
  return answer;
}

export async function get(path, signal) {
  return (await send(path, { signal })).json();
}

export async function text(path, signal) {
  return (await send(path, { signal })).text();
}

export async function post(path, body, more = {}) {
  const answer = await send(path, { method: "POST", body: JSON.stringify(body ?? {}), headers: { "Content-Type": "application/json", ...more } });
  return answer.json();
}

export async function remove(path) {
  return (await send(path, { method: "DELETE" })).json();
}

export async function upload(path, content, signal) {
  return (await send(path, { method: "POST", body: content, headers: { "Content-Type": "text/csv" }, signal })).json();
}

/** Open what needs the token in a window of its own, or save it as a file. */
export async function open(path, name) {
  const url = URL.createObjectURL(await (await send(path)).blob());
  const link = document.createElement("a");
  Object.assign(link, name ? { href: url, download: name } : { href: url, target: "_blank", rel: "noopener" });
  link.click();
  setTimeout(() => URL.revokeObjectURL(url), 60000);
}

/**
 * Follow the events of a tuning from the first one, across broken connections, until one of the type `end`.
 * `take` gets a list of events; `say` gets whether the connection stands.
 */
export async function follow(path, take, say, signal, end = "ended") {
  let last = -1;
  while (!signal.aborted) {
    try {
      const answer = await send(path, { signal, headers: { Accept: "text/event-stream", "Last-Event-ID": String(last) } });
      if (answer.status === 204) return;
      say(true);
      for await (const events of parsed(answer.body)) {
        last = events.at(-1).id;
        take(events.map((event) => event.data));
        if (events.at(-1).data.type === end) return;
      }
    } catch (error) {
      if (signal.aborted || (error instanceof Problem && error.status >= 400)) return;
    }
    say(false);
    await new Promise((done) => setTimeout(done, 1000));
  }
}

async function* parsed(body) {
  const reader = body.pipeThrough(new TextDecoderStream()).getReader();
  let rest = "";
  for (;;) {
    const { value, done } = await reader.read();
    if (done) return;
    const blocks = (rest + value).split(/\r?\n\r?\n/);
    rest = blocks.pop();
    const events = blocks.map(eventOf).filter(Boolean);
    if (events.length) yield events;
  }
}

function eventOf(block) {
  const fields = {};
  for (const line of block.split(/\r?\n/)) {
    const colon = line.indexOf(":");
    if (colon > 0) fields[line.slice(0, colon)] = line.slice(colon + 1).replace(/^ /, "");
  }
  return fields.data ? { id: Number(fields.id), data: JSON.parse(fields.data) } : null;
}
