/** The page that asks for a token. It stores nothing; the session is a cookie that scripts cannot read. */

const form = /** @type {HTMLFormElement} */ (document.getElementById("sign-in"));
const token = /** @type {HTMLInputElement} */ (document.getElementById("token"));
const problem = /** @type {HTMLElement} */ (document.getElementById("problem"));

form.addEventListener("submit", async (event) => {
  event.preventDefault();
  problem.hidden = true;
  const response = await fetch("/session", { method: "POST", headers: { Authorization: `Bearer ${token.value.trim()}` } });
  if (response.ok) {
    location.assign("/");
    return;
  }
  const body = await response.json().catch(() => ({ detail: "The service does not answer; try again." }));
  problem.textContent = body.detail;
  problem.hidden = false;
  token.select();
});
