"""The page holds a bounded number of frames, and drops what was not used for long."""

from __future__ import annotations

from typing import Any

STORE = """async () => {
  const store = await import("/assets/viewer/frame-store.js");
  const part = 4 * 2 ** 20;
  const count = Math.ceil(store.MOST_BYTES / part);
  for (let k = 0; k < 3 * count; k += 1) {
    store.storePart(`part ${k}`, new Uint8Array(part));
    if (store.takePart("part 0") === null) throw new Error("a part in use was dropped");
  }
  const newest = store.hasPart(`part ${3 * count - 1}`);
  const [oldest, bytes] = [store.hasPart("part 1"), store.storedBytes()];
  store.storePart("a large one", new Uint8Array(store.MOST_BYTES + 1));
  return { bytes, most: store.MOST_BYTES, newest, oldest, large: store.hasPart("a large one"), alone: store.storedBytes() };
}"""


def test_frames_of_all_runs_share_one_limit(page: Any) -> None:
    page.goto("/sign-in")
    found = page.evaluate(STORE)
    assert 0.9 * found["most"] < found["bytes"] <= found["most"]
    assert (found["newest"], found["oldest"]) == (True, False)
    # A part that is larger than the limit is the only one.
    assert (found["large"], found["alone"]) == (True, found["most"] + 1)
