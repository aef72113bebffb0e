"""Rendering speed of the phantom: ``python benchmarks/phantom.py [frames]`` prints milliseconds a frame.

Times are processor time of one thread, so that a busy machine gives nearly the figures of an idle machine.
"""

from __future__ import annotations

import sys
import time

import numpy as np

from fluoromap.phantom import Contrast, StudySpec, simulate_study


def main(frames: int) -> None:
    simulate_study(StudySpec(0, sites=1, frames=1)).sites[0].runs[0].frames[0]
    start = time.process_time()
    simulate_study(StudySpec(1))
    print(f"study of 8 sites described      {1000 * (time.process_time() - start):7.0f} ms")
    print("512x512                background   median      p90   ms a frame")
    contrasts: tuple[Contrast, ...] = ("LAT", "PA")
    for contrast in contrasts:
        study = simulate_study(StudySpec(2, sites=1, frames=frames + 1, contrast=(contrast, contrast)))
        for run in study.sites[0].runs:
            times = []
            for index in range(frames + 1):
                start = time.process_time()
                run.frames[index]
                times.append(1000 * (time.process_time() - start))
            warm = np.array(times[1:])
            background = times[0] - np.median(warm)
            print(
                f"{contrast:>3} appearance, view {run.view}  {background:9.0f} {np.median(warm):8.1f} "
                f"{np.percentile(warm, 90):8.1f}"
            )


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 40)
