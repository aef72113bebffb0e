"""A sender that a test can kill again and again: each line of the input forks one that has imported everything already.

The first line of the input is the target as JSON. The program prints the process id of each sender.
"""

from __future__ import annotations

import os
import sys
import time

from fluoromap_service import logs
from fluoromap_service.deliveries.targets import CStoreTarget, StowTarget
from fluoromap_service.sender.service import send_next


def main() -> None:
    logs.configure()
    kind = {"dicom": CStoreTarget, "dicomweb": StowTarget}[sys.argv[1]]
    target = kind.model_validate_json(sys.stdin.readline())
    for _ in sys.stdin:
        process = os.fork()
        if process == 0:
            while True:
                if not send_next(target):
                    time.sleep(0.02)
        print(process, flush=True)
        os.waitpid(process, 0)
        print("ended", flush=True)


if __name__ == "__main__":
    main()
