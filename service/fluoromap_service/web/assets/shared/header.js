/** The line at the top of every page. */
import { get, send } from "./api.js";
import { attempt, button, element } from "./elements.js";

async function signOut() {
  await send("DELETE", "/session");
  location.assign("/sign-in");
}

/** @param {Node[]} trail Links from the list of studies to this page. */
export function header(...trail) {
  const session = element("span", { class: "row" });
  attempt(async () => {
    const { name } = await get("/session");
    // An open service knows nobody, so nobody can sign out.
    if (name !== null) session.append(`Signed in as ${name}`, button("Sign out", () => attempt(signOut), { class: "quiet" }));
  });
  return element(
    "header",
    { class: "top" },
    element("a", { href: "#main", class: "skip" }, "Skip to the content"),
    element("nav", { "aria-label": "Pages" }, element("a", { href: "/", class: "brand" }, "fluoromap"), ...trail),
    element("span", { class: "grow" }),
    element("a", { href: "/docs" }, "API"),
    session,
  );
}
