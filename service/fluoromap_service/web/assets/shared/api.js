/** The service's HTTP API, as any client uses it. */

/** An error that the service explains. */
export class Problem extends Error {
  /** @param {number} status @param {import("./types.js").ProblemBody} body */
  constructor(status, body) {
    const places = (body.errors ?? []).map((each) => `${each.where}: ${each.message}`);
    super([body.detail, ...places].join("\n"));
    this.status = status;
    this.code = body.code;
  }
}

/** @param {Response} response @returns {Promise<Response>} */
async function checked(response) {
  if (response.ok) return response;
  if (response.status === 401) location.assign("/sign-in");
  let body = { code: "unknown", detail: `The service answered ${response.status}; try again.` };
  try {
    body = await response.json();
  } catch {
    // The answer is no problem document: the sentence above has to do.
  }
  throw new Problem(response.status, body);
}

/**
 * @param {string} method
 * @param {string} path
 * @param {unknown} [json]
 * @returns {Promise<any>} The answer's JSON; null without a body.
 */
export async function send(method, path, json) {
  /** @type {RequestInit} */
  const options = { method };
  if (json !== undefined) {
    options.body = JSON.stringify(json);
    options.headers = { "Content-Type": "application/json" };
  }
  const response = await checked(await fetch(path, options));
  return response.status === 204 ? null : response.json();
}

/** @param {string} path @returns {Promise<any>} */
export const get = (path) => send("GET", path);

/** @param {string} path @param {AbortSignal} [signal] @returns {Promise<Uint8Array>} */
export async function getBytes(path, signal) {
  const response = await checked(await fetch(path, { signal: signal ?? null }));
  return new Uint8Array(await response.arrayBuffer());
}

/** Return all items of a list, page after page. @param {string} path @returns {Promise<any[]>} */
export async function getAll(path) {
  const items = [];
  let cursor = "";
  for (;;) {
    const separator = path.includes("?") ? "&" : "?";
    const page = await get(`${path}${separator}limit=500${cursor && `&cursor=${encodeURIComponent(cursor)}`}`);
    items.push(...page.items);
    if (page.next === null) return items;
    cursor = page.next;
  }
}

/**
 * Send a body and report its progress.
 *
 * @param {string} method
 * @param {string} path
 * @param {XMLHttpRequestBodyInit} body
 * @param {string|null} contentType
 * @param {(fraction: number) => void} onProgress
 * @returns {Promise<any>}
 */
export function upload(method, path, body, contentType, onProgress) {
  return new Promise((resolve, reject) => {
    const request = new XMLHttpRequest();
    request.open(method, path);
    if (contentType) request.setRequestHeader("Content-Type", contentType);
    request.upload.onprogress = (event) => event.lengthComputable && onProgress(event.loaded / event.total);
    request.onerror = () => reject(new Problem(0, { code: "offline", detail: "The service does not answer; is it running?" }));
    request.onload = () => {
      let answer = { code: "unknown", detail: `The service answered ${request.status}; try again.` };
      try {
        answer = JSON.parse(request.responseText);
      } catch {
        // As above.
      }
      if (request.status < 300) resolve(answer);
      else reject(new Problem(request.status, answer));
    };
    request.send(body);
  });
}
