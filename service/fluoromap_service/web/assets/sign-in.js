/** The page that asks for a token, or takes a link's secret. It stores nothing; the session is a cookie that scripts cannot read. */

const form = /** @type {HTMLFormElement} */ (document.getElementById("sign-in"));
const token = /** @type {HTMLInputElement} */ (document.getElementById("token"));
const problem = /** @type {HTMLElement} */ (document.getElementById("problem"));

/** @param {string} text */
function show(text) {
  problem.textContent = text;
  problem.hidden = false;
}

/** @param {string} path @param {RequestInit} request @returns {Promise<boolean>} Whether the session has begun. */
async function signIn(path, request) {
  problem.hidden = true;
  try {
    const response = await fetch(path, { method: "POST", ...request });
    if (response.ok) {
      location.replace("/");
      return true;
    }
    show((await response.json()).detail);
  } catch {
    show("The service does not answer; try again.");
  }
  return false;
}

form.addEventListener("submit", async (event) => {
  event.preventDefault();
  const signedIn = await signIn("/session", { headers: { Authorization: `Bearer ${token.value.trim()}` } });
  if (!signedIn) token.select();
});

const link = location.hash.slice(1);
if (!isSecureContext) {
  show("This page came without TLS, so the browser would not keep the session. Open the service at its https address.");
} else if (link) {
  // The history must not keep the secret.
  history.replaceState(null, "", location.pathname);
  void signIn("/sign-in", { headers: { "Content-Type": "application/json" }, body: JSON.stringify({ link }) });
}
