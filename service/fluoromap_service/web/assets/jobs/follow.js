/** Follows a job by its event stream; the browser reconnects by itself. */
import { get } from "../shared/api.js";

const RETRY_MS = 2000;

/**
 * @param {import("../shared/types.js").Job} job
 * @param {(job: import("../shared/types.js").Job) => void} onChange
 * @returns {Promise<import("../shared/types.js").Job>} The job when it has ended.
 */
export function follow(job, onChange) {
  return new Promise((resolve) => {
    const source = new EventSource(`/v1/jobs/${job.id}/events`);
    source.addEventListener("error", () => {
      // The browser gives up after a refusal, for example while the service starts again.
      if (source.readyState === EventSource.CLOSED) setTimeout(() => resolve(follow(job, onChange)), RETRY_MS);
    });
    const stages = new Map(job.stages.map((stage) => [`${stage.name}/${stage.subject}`, stage]));
    source.addEventListener("stage", (event) => {
      const news = JSON.parse(event.data);
      const stage = stages.get(`${news.name}/${news.subject}`);
      if (stage) Object.assign(stage, news);
      onChange(job);
    });
    source.addEventListener("job", async (event) => {
      job.state = JSON.parse(event.data).state;
      onChange(job);
      if (job.state === "queued" || job.state === "running") return;
      source.close();
      resolve(await get(`/v1/jobs/${job.id}`));
    });
  });
}
