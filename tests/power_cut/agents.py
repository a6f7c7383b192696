"""Plays sessions on a server with a file store, and prints every answer. Runs on the machine that __main__.py starts.

Each line has one answer: "power: answered SESSION DECISION DIGEST". It is printed after the answer has arrived, so what was
printed was acknowledged. At the start a line for each session shows how many decisions the store has, and the last of them
is asked for again.
"""

import hashlib
import os
import pathlib
import subprocess
import sys

ROOT = pathlib.Path(__file__).parents[2]
sys.path[:0] = [str(ROOT / "tests" / "python")]

import grpc
from serving import running_server
from stored_sessions import acting, comparable, opening

SESSIONS = 16
STEPS = 40  # of an episode: that of acting()
STORE = "/run/disk/sessions"


def say(*words):
    print("power:", *words, flush=True)


def digest(answer):
    return hashlib.sha256(comparable(answer)).hexdigest()[:16]


def request(i, decision):
    """Returns the request for a decision of session i."""
    return acting(i, decision // STEPS, decision % STEPS)


def end_episode_after(service, i, decision):
    """Ends the episode if this was its last decision. Does so again if the store had the end."""
    if decision >= 0 and decision % STEPS == STEPS - 1:
        service.EndEpisode(
            session_id=f"{i:032x}", reward=1.0 + i, terminated=True, episode=decision // STEPS, steps=STEPS
        )


def check_store():
    """Prints what spikectl says of the store."""
    if not pathlib.Path(STORE).exists():
        return
    program = [os.environ["SPIKECTL_PROGRAM"], "store", "check", f"--session_store=file:{STORE}"]
    check = subprocess.run(program, check=False, capture_output=True, text=True)
    say("check", check.returncode, (check.stdout + check.stderr).replace("\n", " | "))


def resume(service, i):
    """Opens session i again and returns the number of its next decision."""
    service.OpenSession(**opening(i))
    decisions = service.GetSession(session_id=f"{i:032x}").decisions
    say("has", i, decisions)
    try:  # unless the episode has ended, the last answer can be asked for again
        answer = service.Act(**request(i, decisions - 1)) if decisions else None
    except grpc.RpcError as error:
        assert error.code() == grpc.StatusCode.FAILED_PRECONDITION, error
        answer = None
    if answer is not None:
        say("answered", i, decisions - 1, digest(answer))
    end_episode_after(service, i, decisions - 1)
    return decisions


def play(service, decisions):
    """Makes single calls and batches in turn, without an end."""
    while True:
        for i in range(SESSIONS):
            answer = service.Act(**request(i, decisions[i]))
            say("answered", i, decisions[i], digest(answer))
        for i in range(SESSIONS):
            end_episode_after(service, i, decisions[i])
        decisions = [decision + 1 for decision in decisions]
        requests = [request(i, decisions[i]) for i in range(SESSIONS)]
        for i, result in enumerate(service.ActBatch(requests=requests).results):
            assert result.code == 0, result
            say("answered", i, decisions[i], digest(result.response))
        for i in range(SESSIONS):
            end_episode_after(service, i, decisions[i])
        decisions = [decision + 1 for decision in decisions]


def main():
    check_store()
    with running_server(flags=[f"--session_store=file:{STORE}"]) as server:
        play(server.agent, [resume(server.agent, i) for i in range(SESSIONS)])


if __name__ == "__main__":
    main()
