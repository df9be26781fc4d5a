// Requests to the web process. Every failure is an Error whose message is a sentence for the operator.

export class ApiError extends Error {
  constructor(message, status) {
    super(message);
    this.status = status;
  }
}

async function answer(promise) {
  let response;
  try {
    response = await promise;
  } catch {
    throw new ApiError("The connection to the rig is lost; nothing was done.", 0);
  }
  const body = await response.json().catch(() => ({}));
  if (!response.ok) throw new ApiError(body.error ?? `The rig answered with status ${response.status}.`, response.status);
  return body;
}

export const get = (path) => answer(fetch(path, { credentials: "same-origin" }));

export const post = (path, body) => answer(fetch(path, {
  method: "POST",
  credentials: "same-origin",
  headers: { "Content-Type": "application/json" },
  body: JSON.stringify(body),
}));

/** The name that a person without a token has entered; it is stored in this browser. */
export const operator = {
  get name() { try { return localStorage.getItem("operator") ?? ""; } catch { return ""; } },
  set name(name) { try { localStorage.setItem("operator", name); } catch { /* private browsing: asked again */ } },
};

/** Send one command to the daemon and return its result. */
export const command = async (name, args = {}) =>
  (await post("/api/command", { command: name, arguments: args, operator: operator.name })).result;
