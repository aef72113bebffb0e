/** The line at the top of every page. */
import { send } from "./api.js";
import { attempt, button, element } from "./elements.js";

/** @param {Node[]} trail Links from the list of studies to this page. */
export function header(...trail) {
  const signOut = button("Sign out", () =>
    attempt(async () => {
      await send("DELETE", "/session");
      location.assign("/sign-in");
    }), { class: "quiet" });
  return element(
    "header",
    { class: "top" },
    element("a", { href: "#main", class: "skip" }, "Skip to the content"),
    element("nav", { "aria-label": "Pages" }, element("a", { href: "/", class: "brand" }, "fluoromap"), ...trail),
    element("span", { class: "grow" }),
    element("a", { href: "/docs" }, "API"),
    signOut,
  );
}
