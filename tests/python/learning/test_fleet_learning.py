"""Tests the operations on the head that a fleet has learned, and its protection against bad input."""

import concurrent.futures
import json
import pathlib
import shutil

import grpc
import numpy as np
import pytest
from policy_file import read_policy
from security import code_of, fails_with
from serving import RELEASED_POLICIES, SHIPPED_POLICIES, metric, running_server

FLEET = {"scope": "FLEET", "learning_rate": 0.3}
SAMPLING = {"action_selection": "SAMPLE", "temperature": 4.0}


@pytest.fixture(params=[RELEASED_POLICIES / "cartpole-sparse/1", SHIPPED_POLICIES / "cartpole-small/1"], ids=["float32", "integer"])
def folder(tmp_path, request):
    """Returns a folder with one version of the policy as version 1."""
    shutil.copytree(request.param, tmp_path / "cartpole" / "1")
    return tmp_path


class Learner:
    def __init__(self, server):
        self.policy, self.admin = server.agent, server.admin

    def open(self, **fields):
        return self.policy.OpenSession(policy="cartpole", **fields).session_id

    def play(self, session_id, steps=12, reward=lambda step: 1.0, **end):
        """Plays one episode of an artificial environment. Returns the probabilities and the end."""
        answers = []
        for step in range(steps):
            angles = np.sin(0.3 * step + np.arange(4)) * 0.1
            answer = self.policy.Act(
                session_id=session_id, step=step, observation=angles, reward=reward(step)
            )
            answers.append(tuple(answer.action_probabilities))
        ended = self.policy.EndEpisode(session_id=session_id, reward=reward(steps), **end)
        return answers, ended

    def teach(self, episodes=3, **opening):
        session_id = self.open(seed=1, learning=FLEET, **SAMPLING, **opening)
        for _ in range(episodes):
            self.play(session_id, terminated=True)


@pytest.fixture
def serve(folder):
    def run(act):
        with running_server(folder) as addresses:
            return act(Learner(addresses))

    return run


def test_a_promoted_head_is_served_bit_for_bit_across_a_restart(folder, serve):
    def promote(server):
        server.teach()
        head = server.admin.GetHead(policy="cartpole", include_weights=True)
        promoted = server.admin.PromoteHead(policy="cartpole")
        # One frozen session starts with the learned head, another one uses the new version.
        learned = server.play(server.open(version=1, head_delta=head.delta))[0]
        served = server.play(server.open(version=promoted.version))[0]
        assert learned == served != server.play(server.open(version=1))[0]
        fresh = server.admin.GetHead(policy="cartpole", version=promoted.version)
        assert fresh.drift == 0 and fresh.base_norm != pytest.approx(head.base_norm, rel=1e-6)
        return head, promoted, served

    head, promoted, before = serve(promote)
    assert promoted.version == 2
    path = pathlib.Path(promoted.path)
    assert path == folder / "cartpole/2/policy.safetensors"
    tensors, metadata = read_policy(path)
    parents, _ = read_policy(folder / "cartpole/1/policy.safetensors")
    delta = np.array(head.delta, "f4").reshape(tensors["head.weight"].shape)
    assert (tensors["head.weight"] == parents["head.weight"] + delta).all()
    training = json.loads(metadata["training"])
    lineage = training["promoted"]
    assert lineage["parent_version"] == 1 and lineage["updates"] == 3
    assert lineage["delta_norm"] == pytest.approx(head.delta_norm)
    assert lineage["base_norm"] == pytest.approx(head.base_norm)
    assert "evaluation" in training["parent_training"]
    # Version 2 is the default after the restart, and gives the same answers.
    assert serve(lambda server: server.play(server.open())[0]) == before


def test_after_a_rollback_the_old_answers_return_bit_for_bit(serve):
    def roll_back(server):
        watcher = server.open(learning=FLEET)  # greedy, on the fleet's head
        server.admin.PauseLearning(policy="cartpole")
        before = server.play(watcher)[0]
        server.admin.ResumeLearning(policy="cartpole")
        server.teach()
        server.admin.PauseLearning(policy="cartpole")
        assert server.play(watcher)[0] != before
        drift = server.admin.GetHead(policy="cartpole").drift
        assert server.admin.RollbackHead(policy="cartpole").drift == drift > 0
        assert server.play(watcher)[0] == before
        head = server.admin.GetHead(policy="cartpole")
        assert head.drift == 0 and head.updates == 0 and head.rollbacks == 1

    serve(roll_back)


def test_a_promotion_takes_a_new_number_and_a_rollback_is_of_one_version(folder, serve):
    def promote(server):
        server.teach()
        (folder / "cartpole/7").mkdir()  # has no policy file, and is not served
        assert [server.admin.PromoteHead(policy="cartpole", version=1).version for _ in range(2)] == [8, 9]
        server.teach(version=9)
        assert server.admin.RollbackHead(policy="cartpole", version=1).drift > 0
        heads = [server.admin.GetHead(policy="cartpole", version=version) for version in (1, 8, 9)]
        assert [(head.drift > 0, head.rollbacks) for head in heads] == [(False, 1), (False, 0), (True, 0)]

    serve(promote)


@pytest.mark.parametrize("scope", ["SESSION", "FLEET"])
def test_a_paused_policy_learns_nothing_until_it_is_resumed(serve, scope):
    def pause(server):
        session_id = server.open(seed=1, learning={"scope": scope}, **SAMPLING)
        server.admin.PauseLearning(policy="cartpole")
        assert server.admin.GetHead(policy="cartpole").paused
        _, ended = server.play(session_id, terminated=True)
        assert ended.learning.updates == 0 and ended.learning.head_drift == 0
        server.admin.ResumeLearning()
        _, ended = server.play(session_id, terminated=True)
        assert ended.learning.updates == 1 and ended.learning.head_drift > 0

    serve(pause)


def test_a_pause_holds_for_every_version_until_it_is_ended(serve):
    def pause(server):
        server.teach()
        server.admin.PauseLearning(policy="cartpole")
        version = server.admin.PromoteHead(policy="cartpole").version
        assert server.admin.GetHead(policy="cartpole", version=version).paused
        server.admin.ResumeLearning(policy="cartpole")
        for each in [1, version]:
            assert not server.admin.GetHead(policy="cartpole", version=each).paused

    serve(pause)


def test_absurd_rewards_harm_neither_others_nor_the_fleet_beyond_its_bound(serve):
    def poison(server):
        frozen = server.open()
        before = server.play(frozen)[0]
        poisoner = server.open(learning=FLEET | {"learning_rate": 1e9, "clip": 1e9}, **SAMPLING)
        for sign in [1, -1, 1, -1]:
            rewards = [lambda step, s=sign: s * 1e30, lambda step, s=sign: s * 1e30 * (-1) ** step]
            for reward in rewards:
                _, ended = server.play(poisoner, reward=reward, terminated=True)
                assert np.isfinite(ended.learning.modulator_mean)
                head = server.admin.GetHead(policy="cartpole", include_weights=True)
                assert np.isfinite(head.delta).all()
                assert head.drift <= 2 + 1e-6
        assert code_of(server.play, poisoner, reward=lambda step: float("nan")) == grpc.StatusCode.INVALID_ARGUMENT
        assert server.play(frozen)[0] == before
        member = server.open(learning=FLEET, **SAMPLING)
        assert np.isfinite(server.play(member)[0]).all()

    serve(poison)


MERGE_TOLERANCE = 1e-5  # absolute, for each weight; equal to FleetHead::kMergeTolerance


def test_the_fleets_head_does_not_depend_on_who_ends_first(serve):
    """64 sessions play one episode each on one head. They end concurrently or one by one."""

    def learn(server, end_all):
        server.admin.RollbackHead(policy="cartpole")
        # With this small learning rate, neither the drift bound nor the clip applies.
        learning = FLEET | {"learning_rate": 0.003}
        # The same ids are held out each time, and do not contribute.
        sessions = [
            server.open(seed=seed, learning=learning, session_id=f"{seed:032x}", **SAMPLING) for seed in range(64)
        ]
        for i, session_id in enumerate(sessions):
            for step in range(4 + i % 3):
                angles = np.sin(0.3 * step + i + np.arange(4)) * 0.1
                server.policy.Act(session_id=session_id, step=step, observation=angles, reward=1.0 + i % 5)

        def end(session_id):
            server.policy.EndEpisode(session_id=session_id, reward=1.0, terminated=True)

        end_all(end, sessions)
        head = server.admin.GetHead(policy="cartpole", include_weights=True)
        assert 32 < head.updates < 64 and 0 < head.drift < 1.9
        for session_id in sessions:
            server.policy.CloseSession(session_id=session_id)
        return np.array(head.delta)

    def together(end, sessions):
        with concurrent.futures.ThreadPoolExecutor(len(sessions)) as executor:
            list(executor.map(end, sessions))

    def backwards(end, sessions):
        for session_id in reversed(sessions):
            end(session_id)

    def compare(server):
        heads = [learn(server, end_all) for end_all in (together, together, backwards)]
        assert np.abs(heads[0]).max() > 100 * MERGE_TOLERANCE
        for head in heads[1:]:
            assert np.abs(head - heads[0]).max() <= MERGE_TOLERANCE

    serve(compare)


@pytest.mark.parametrize("scope", ["session", "fleet"])
def test_the_guard_rolls_back_and_says_so(folder, tmp_path_factory, scope):
    path = tmp_path_factory.mktemp("log") / "stderr"
    with running_server(folder, log=path) as addresses:
        server = Learner(addresses)
        session_id = server.open(seed=1, learning={"scope": scope.upper()}, **SAMPLING)
        for episode in range(40):
            reward = 1.0 if episode < 20 else 0.5  # half the return in the second window
            _, ended = server.play(session_id, reward=lambda step, r=reward: r, terminated=True)
            assert ended.learning.rolled_back == (episode == 39)
            assert (ended.learning.head_drift > 0) == (episode < 39)
        assert ended.learning.watched_return == pytest.approx(6)
        assert server.policy.GetSession(session_id=session_id).rollbacks == 1
        assert server.admin.GetHead(policy="cartpole").rollbacks == (scope == "fleet")
        assert metric(addresses, "spikeserve_learning_rollbacks_total", scope=scope) == 1
        assert metric(addresses, "spikeserve_learning_return", scope=scope) == pytest.approx(6)
        assert metric(addresses, "spikeserve_head_drift_ratio", scope=scope) == 0
    logged = f'warning action head rolled back policy="cartpole/1" scope="{scope}" watched_return="6"\n'
    assert path.read_text().count(logged) == 1


@pytest.mark.parametrize(
    "fields, message",
    [
        ({"head_delta": [1.0]}, "head_delta: expected 64 numbers, received 1"),
        ({"head_delta": [float("inf")] * 64}, "head_delta[0]: expected a finite number"),
        ({"head_delta": [0.0] * 64, "learning": FLEET}, "where learning.scope is FLEET"),
        ({"learning": FLEET | {"max_drift": 5}}, "learning.max_drift: expected unset unless scope"),
        ({"learning": {"modulator": "target", "discount": 0.5}}, "learning.discount: expected unset"),
    ],
)
def test_what_would_do_nothing_or_harm_is_refused(serve, fields, message):
    def refuse(server):
        with fails_with(grpc.StatusCode.INVALID_ARGUMENT, message):
            server.open(**fields)

    serve(refuse)


def test_what_was_not_learned_is_not_promoted(serve):
    def promote(server):
        assert code_of(server.admin.PromoteHead, policy="cartpole") == grpc.StatusCode.FAILED_PRECONDITION
        assert code_of(server.admin.PromoteHead, policy="cartpole", version=5) == grpc.StatusCode.NOT_FOUND
        for call in [server.admin.GetHead, server.admin.RollbackHead, server.admin.PauseLearning]:
            assert code_of(call, policy="nobody") == grpc.StatusCode.NOT_FOUND

    serve(promote)
