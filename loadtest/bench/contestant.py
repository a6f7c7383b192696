"""The Python side of contestant.h: a process that measures itself in rounds."""

import json
import sys
import time


def run(decide):
    """Answers rounds, in each of which `decide()`, one decision, is called until the time is over."""
    print("ready", flush=True)
    for line in sys.stdin:
        duration = float(line)
        decisions = 0
        start = now = time.process_time()
        while now - start < duration:
            decide()
            decisions += 1
            now = time.process_time()
        print(json.dumps({"decisions": decisions, "seconds": now - start, "spikes": 0}), flush=True)
