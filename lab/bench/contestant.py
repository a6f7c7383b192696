"""The Python form of contestant.h: a process that measures itself in rounds."""

import json
import sys
import time


def run(decide):
    """Runs one round for each line of stdin, which holds its duration in seconds of processor time.

    A round calls `decide()`, which makes one decision, until the time is over. Then it prints its counts as JSON.
    """
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
