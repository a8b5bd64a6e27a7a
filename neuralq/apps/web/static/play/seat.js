// Talking to the server: a seat of this tab, questions with the revision that is shown, and what is remembered.

const KEY = `neuralq-seat-${location.pathname}-${document.title}`;

export function remembered(name, fallback) {
  try {
    return localStorage.getItem(`neuralq-${name}`) ?? fallback;
  } catch {
    return fallback; // a browser that keeps nothing
  }
}

export function remember(name, value) {
  try {
    localStorage.setItem(`neuralq-${name}`, value);
  } catch { /* then it is asked again next time */ }
}

async function post(name, body) {
  let reply;
  try {
    reply = await fetch(`/api/${name}`, {
      method: "POST", headers: { "content-type": "application/json" }, body: JSON.stringify(body),
    });
  } catch {
    throw new Error("The server does not answer; is it still running?");
  }
  const found = await reply.json();
  if (!reply.ok) throw Object.assign(new Error(found.error), { status: reply.status });
  return found;
}

export class Seat {
  constructor() {
    this.revision = 0;
    this.busy = false;
    try {
      this.token = sessionStorage.getItem(KEY);
    } catch {
      this.token = null;
    }
  }

  async start(fields = {}) {
    return this.took(await post("start", fields));
  }

  // The state that was left in this tab, or a new seat; ?seed=7 in the address makes its dice known.
  async resume() {
    const seed = new URLSearchParams(location.search).get("seed");
    const fields = seed === null ? {} : { seed: Number(seed) };
    if (this.token !== null) {
      try {
        return { state: this.took(await post("state", { seat: this.token })), isNew: false };
      } catch (error) {
        if (error.status !== 404) throw error;
      }
    }
    return { state: await this.start(fields), isNew: true };
  }

  took(state) {
    this.token = state.seat;
    if (state.revision !== undefined) this.revision = state.revision;
    try {
      sessionStorage.setItem(KEY, this.token);
    } catch { /* then a reload begins anew */ }
    return state;
  }

  async ask(name) {
    return post(name, { seat: this.token });
  }

  // Does something; null if another question is still on its way. If the state shown was too old, the new one comes.
  async act(name, fields = {}) {
    if (this.busy) return null;
    this.busy = true;
    try {
      return { state: this.took(await post(name, { seat: this.token, revision: this.revision, ...fields })) };
    } catch (error) {
      if (error.status === 404) return { state: await this.start(), complaint: error.message, isNew: true };
      if (error.status === 409) return { state: this.took(await this.ask("state")), complaint: error.message };
      return { complaint: error.message };
    } finally {
      this.busy = false;
    }
  }
}

// An unchanged text is not read out again.
export function say(element, text) {
  if (element.textContent !== text) element.textContent = text;
}

// What could not be done, in the page's line for it; without a text the line is hidden.
export function complain(text) {
  const line = document.getElementById("error");
  line.hidden = !text;
  line.textContent = text ?? "";
}
