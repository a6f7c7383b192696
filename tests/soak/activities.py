"""What a month brings, again and again: agents of all kinds, operators, readers, killed clients.

Each activity is a function that does one round of its kind. Errors of the activities end the soak, except those in
EXPECTED, which the activities cause for each other.
"""

import json
import os
import pathlib
import random
import shutil
import subprocess
import sys
import threading

import grpc
from security import ADMIN, POLICY
from serving import SHIPPED_POLICIES, http_call

OBSERVATION = [0.1, -0.1, 0.05, 0.0]
STEPS = 25
REMEMBERED_ACTIONS = 1000  # see AuditLog
SWAPPED = 90  # a version whose file changes
# A version that a session wants is being unloaded, or one is promoted before a session has taught its head.
EXPECTED = {grpc.StatusCode.NOT_FOUND, grpc.StatusCode.FAILED_PRECONDITION}
LOADS = (
    ["--mode=stream", "--sessions=64", "--streams=2"],
    ["--mode=unary", "--sessions=16", "--streams=4"],
    ["--mode=batch", "--sessions=64", "--streams=2"],
    ["--mode=stream", "--sessions=16", "--streams=1", "--learning_scope=session"],
    ["--mode=unary", "--sessions=8", "--streams=2", "--learning_scope=fleet", "--episode_steps=20"],
)


def spikeload(server, seconds, flags):
    command = [
        *(os.environ["SPIKELOAD_PROGRAM"], f"--server={server.addresses.grpc}", "--policy=cartpole"),
        *(f"--token_file={server.agent_token}", f"--duration={seconds}s", "--call_timeout=60s", "--json", *flags),
    ]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def failed_requests(load, seconds):
    """Waits for a load and returns how many of its requests failed."""
    output, errors = load.communicate(timeout=seconds + 600)
    if load.returncode == 0 or output:
        return json.loads(output)["errors"]
    # On a busy machine a load may end before its first decision, when a session ends or a call takes too long.
    print(f"soak: {' '.join(load.args[-3:])}: {errors.strip()}", file=sys.stderr, flush=True)
    return 1


def play(service, steps=STEPS, **options):
    """Plays an episode in a session of its own, and returns the id of the session, which stays open."""
    session = service.OpenSession(policy="cartpole", **options).session_id
    for step in range(steps):
        service.Act(session_id=session, step=step, observation=OBSERVATION, reward=float(step % 3))
    return session


class Activities:
    """Runs the activities, each in a thread that pauses for some seconds after each round, until stop()."""

    def __init__(self, server, pause):
        self._server = server
        self._pause = pause
        self._stop = threading.Event()
        self._errors = []
        self.counts = {}
        rounds = (
            self.explain,
            self.record,
            self.swap,
            self.promote,
            self.replace,
            self.reload_tokens,
            self.read,
            self.kill,
        )
        self._threads = [threading.Thread(target=self._run, args=[each]) for each in rounds]
        for thread in self._threads:
            thread.start()

    def stop(self):
        """Ends all threads. Raises the first unexpected error of one of them."""
        self._stop.set()
        for thread in self._threads:
            thread.join()
        if self._errors:
            raise self._errors[0]

    def _run(self, work):
        name = work.__name__
        server = self._server
        try:
            with server.service("agent", POLICY) as agent, server.service("operator", ADMIN) as operator:
                while not self._stop.is_set():
                    try:
                        work(agent, operator)
                    except grpc.RpcError as error:
                        if error.code() not in EXPECTED:
                            raise
                    self.counts[name] = self.counts.get(name, 0) + 1
                    self._stop.wait(self._pause)
        except Exception as error:  # stop() raises it
            self._errors.append(error)

    def explain(self, agent, _):
        session = play(agent, steps=5)
        agent.Explain(session_id=session)
        agent.CloseSession(session_id=session)

    def record(self, agent, _):
        session = play(agent, record=True)
        agent.EndEpisode(session_id=session, reward=1.0, terminated=True)
        agent.CloseSession(session_id=session)
        old = sorted(self._server.recordings.iterdir(), key=lambda path: path.stat().st_mtime)[:-20]
        for folder in old:
            shutil.rmtree(folder)

    def swap(self, _, operator):
        operator.SetDefaultVersion(policy="cartpole", version=random.choice([1, 2]))
        label = f"label-{random.randrange(10**9)}"
        operator.SetLabel(policy="cartpole", version=1, label=label)
        shares = [{"version": 1, "percent": 30}, {"version": 2, "percent": 70}]
        operator.SetTraffic(policy="cartpole", shares=shares, shadow_version=random.choice([0, 1]))
        operator.SetTraffic(policy="cartpole", shares=[], shadow_version=0)
        operator.RemoveLabel(policy="cartpole", label=label)

    def promote(self, agent, operator):
        session = play(agent, version=2, action_selection="SAMPLE", learning={"scope": "FLEET", "learning_rate": 0.5})
        agent.EndEpisode(session_id=session, reward=5.0, terminated=True)
        agent.CloseSession(session_id=session)
        promoted = operator.PromoteHead(policy="cartpole", version=2)
        agent.CloseSession(session_id=play(agent, version=promoted.version))
        operator.UnloadPolicy(policy="cartpole", version=promoted.version)
        shutil.rmtree(pathlib.Path(promoted.path).parent)

    def replace(self, agent, operator):
        target = self._server.policies / f"cartpole/{SWAPPED}"
        target.mkdir(exist_ok=True)
        following = target / "policy.safetensors.next"
        shutil.copy(SHIPPED_POLICIES / f"cartpole/{random.choice([1, 2])}/policy.safetensors", following)
        following.rename(target / "policy.safetensors")
        operator.LoadPolicy(policy="cartpole", version=SWAPPED)
        agent.CloseSession(session_id=play(agent, version=SWAPPED))
        shutil.rmtree(target)
        operator.ReloadPolicies()

    def reload_tokens(self, agent, _):
        self._server.write_tokens()
        agent.ListPolicies()
        self._stop.wait(1.0)  # the server looks once a second

    def read(self, _, operator):
        for path in ("/metrics", "/status.json", "/history.json", "/sessions.json?sort=decisions", "/"):
            self._server.page(path)
        for session in json.loads(self._server.page("/sessions.json"))["sessions"][:1]:
            # It may have ended meanwhile.
            path = f"/session.json?session={session['session_id']}"
            http_call(self._server.addresses.http, "GET", path, token="operator")
        operator.ListSessions(page_size=100)

    def kill(self, *_):
        """Kills a client in the middle of its calls, which leaves its sessions behind."""
        mode = random.choice(["stream", "unary", "batch"])
        load = spikeload(self._server, 60, [f"--mode={mode}", "--sessions=16", "--streams=2"])
        self._stop.wait(random.uniform(0.3, 1.5))
        load.kill()
        load.communicate()


def fill_memory_of_actions(server):
    """Lets operators act until the server has as many of their actions in memory as it keeps."""
    with server.service("operator", ADMIN) as operator:
        for i in range(REMEMBERED_ACTIONS):
            operator.SetDefaultVersion(policy="cartpole", version=1 + i % 2)


def soak(server, seconds, rate, pause):
    """Does everything at the same time for `seconds`. Returns how often each activity was done, and failed requests."""
    loads = [spikeload(server, seconds, [*flags, f"--rate={rate}"]) for flags in LOADS]
    activities = Activities(server, pause)
    failed = 0
    try:
        for load in loads:
            failed += failed_requests(load, seconds)
    finally:
        for load in loads:
            load.kill()
            load.wait()
        activities.stop()
    return activities.counts, failed
