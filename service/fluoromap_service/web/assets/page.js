/** Starts the page that the address names: all studies, or one study. */
import { attempt } from "./shared/elements.js";

const { start } = await (location.pathname === "/" ? import("./studies/page.js") : import("./study/page.js"));
await attempt(start);
document.body.dataset.ready = "yes";
