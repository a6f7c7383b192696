"""A damaged page, a full disk and a removed lock cost a file store at most the sessions that they hit.

A time of day that jumps costs none.
"""

import contextlib
import itertools
import random
import shutil

import grpc
import pytest
from machine import Clock, fill, small_disk
from security import code_of, until
from serving import refusal_at_start, running_server
from stored_sessions import Restartable, acting, comparable, expected_decision, opening, undisturbed_answers

SESSIONS = 48
STEPS = 40
PAGE = 4096
BRANCH, LEAF = 1, 2  # flags of pages
TRIES = 20
META_PAGES = 2
DISK = 12 << 20  # bytes
MOST_SESSIONS = 20_000  # more than the disk has room for


def name(i):
    return f"{i:032x}"


@pytest.fixture(scope="module")
def played(tmp_path_factory):
    """Plays sessions on a store until its server is killed. Returns the folder of the store and all answers."""
    folder = tmp_path_factory.mktemp("played")
    answers = {i: [] for i in range(SESSIONS)}
    with Restartable(f"file:{folder}/store") as server:
        for i in range(SESSIONS):
            server.OpenSession(**opening(i))
        for step in range(STEPS):
            response = server.ActBatch(requests=[acting(i, 0, step) for i in range(SESSIONS)])
            for i, result in enumerate(response.results):
                answers[i].append(comparable(result.response))
        server.kill()
        shutil.copytree(folder / "store", folder / "killed")
        # What follows the kill is what a store without damage continues with.
        server.start()
        for i in range(SESSIONS):
            answers[i].append(comparable(server.Act(**acting(i, 0, STEPS))))
    return folder / "killed", answers


def overwrite(file, page, content):
    file[page * PAGE : page * PAGE + len(content)] = content


def page_of(file, page):
    return file[page * PAGE : (page + 1) * PAGE]


def names_tables(content):
    """Returns whether a page shows where the tables are. Without it nothing can be read."""
    return b"records" in content and b"sessions" in content


def pages_of(file, kind):
    """Returns the numbers of the pages with a flag of LMDB in their headers, those that name the tables excepted."""
    return [
        page
        for page in range(META_PAGES, len(file) // PAGE)
        if int.from_bytes(page_of(file, page)[10:12], "little") == kind and not names_tables(page_of(file, page))
    ]


def random_page(file, chance, kind):
    """One page holds anything. Returns the numbers of the damaged pages, like all of these."""
    page = chance.choice(pages_of(file, kind))
    overwrite(file, page, chance.randbytes(PAGE))
    return [page]


def empty_page(file, chance, kind):
    """One page was never written, as after a lost write."""
    page = chance.choice(pages_of(file, kind))
    overwrite(file, page, bytes(PAGE))
    return [page]


def other_page(file, chance, kind):
    """One page holds another one, as after a misdirected write."""
    page = chance.choice(pages_of(file, kind))
    other = chance.choice([each for each in pages_of(file, LEAF) if each != page])
    overwrite(file, page, page_of(file, other))
    return [page]


def headers(file, chance, kind):
    """The bounds in the headers of one tenth of the pages are wrong."""
    pages = pages_of(file, kind)
    chosen = chance.sample(pages, len(pages) // 10 + 1)
    for page in chosen:
        file[page * PAGE + 12 : page * PAGE + 16] = chance.randbytes(4)
    return chosen


DAMAGES = [random_page, empty_page, other_page, headers]


def damaged(played, folder, damage):
    """Returns a damaged copy of a store, and the sessions that the damaged pages named."""
    store = folder / "store"
    shutil.copytree(played, store)
    before = (store / "data.mdb").read_bytes()
    file = bytearray(before)
    contents = [page_of(before, page) for page in damage(file)]
    (store / "data.mdb").write_bytes(file)
    return store, {i for i in range(SESSIONS) if any(name(i).encode() in content for content in contents)}


def continue_session(server, i, answers):
    """Sends the next decision, and before it those that the server asks for. Returns whether the session continues."""
    step = STEPS
    tries = 0
    while step <= STEPS:
        try:
            answer = server.Act(**acting(i, 0, step))
        except grpc.RpcError as error:
            if error.code() in (grpc.StatusCode.DATA_LOSS, grpc.StatusCode.NOT_FOUND):
                return False
            if error.code() == grpc.StatusCode.UNAVAILABLE:
                tries += 1
                assert tries < TRIES, error
                continue
            assert error.code() == grpc.StatusCode.FAILED_PRECONDITION, error
            assert expected_decision(server.channel, error) < step
            step = expected_decision(server.channel, error)
            continue
        assert comparable(answer) == answers[i][step]
        step += 1
    return True


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("damage", DAMAGES)
def test_sessions_outside_of_damaged_pages_go_on(played, tmp_path, damage, seed):
    folder, answers = played
    store, hit = damaged(folder, tmp_path, lambda file: damage(file, random.Random(seed), LEAF))
    with Restartable(f"file:{store}") as server:
        lost = {i for i in range(SESSIONS) if not continue_session(server, i, answers)}
        assert lost <= hit
        # What was lost can be opened anew, beside the others.
        opened = server.OpenSession(policy="cartpole", durability="SYNC").session_id
        server.restart()
        assert server.GetSession(session_id=opened).session_id == opened


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_inner_page_ends_no_server(played, tmp_path, damage):
    """The pages below an inner page cannot be found, so that many sessions may be lost. None decides otherwise."""
    folder, answers = played
    store, _ = damaged(folder, tmp_path, lambda file: damage(file, random.Random(1), BRANCH))
    with Restartable(f"file:{store}") as server:
        for i in range(SESSIONS):
            continue_session(server, i, answers)
        assert server.OpenSession(policy="cartpole", durability="SYNC").session_id


def anything(file):
    overwrite(file, 0, random.Random(1).randbytes(len(file)))
    return []


def cut_off(file):
    """The file ends before its tables."""
    del file[META_PAGES * PAGE :]
    return []


def no_tables(file):
    """No page says any more where the tables are."""
    for page in range(META_PAGES, len(file) // PAGE):
        if names_tables(page_of(file, page)):
            overwrite(file, page, bytes(PAGE))
    return []


@pytest.mark.parametrize("damage", [anything, cut_off, no_tables])
def test_a_file_of_which_nothing_can_be_read_is_named(played, tmp_path, damage):
    store, _ = damaged(played[0], tmp_path, damage)
    before = (store / "data.mdb").read_bytes()
    said = refusal_at_start(f"--session_store=file:{store}")
    assert str(store / "data.mdb") in said
    assert (store / "data.mdb").read_bytes() == before


@pytest.fixture
def disk(tmp_path):
    with small_disk(tmp_path / "disk", DISK) as folder:
        if folder is None:
            pytest.skip("mounting needs root")
        yield folder


def test_a_full_disk_refuses_sessions_and_lets_others_end(disk):
    with Restartable(f"file:{disk}/store") as server:
        for i in range(SESSIONS):
            server.OpenSession(**opening(i))
            server.Act(**acting(i, 0, 0))
        filler = fill(disk)
        refused = next(
            code
            for i in range(SESSIONS, MOST_SESSIONS)
            if (code := code_of(server.OpenSession, **opening(i))) != grpc.StatusCode.OK
        )
        assert refused == grpc.StatusCode.UNAVAILABLE
        closed, left = range(SESSIONS // 2), range(SESSIONS // 2, SESSIONS)
        for i in closed:
            server.CloseSession(session_id=name(i))
        filler.unlink()
        server.restart()
        for i in closed:
            assert code_of(server.GetSession, session_id=name(i)) == grpc.StatusCode.NOT_FOUND
        for i in left:
            assert server.Act(**acting(i, 0, 1)).durable_decision == 2


def alike(i):
    """Returns the request that opens session i as one that learns by itself, whose snapshots are large."""
    return opening(4) | {"session_id": name(i)}


def test_a_store_that_has_filled_its_disk_has_room_again_when_its_sessions_end(disk):
    with Restartable(f"file:{disk}/store") as server:
        for restarts in (False, True, False):
            opened = []
            while code_of(server.OpenSession, **alike(len(opened))) == grpc.StatusCode.OK:
                opened.append(len(opened))
                assert len(opened) < MOST_SESSIONS
            assert len(opened) > SESSIONS
            # The one that was refused is stored as soon as there is room.
            for i in (*opened, len(opened)):
                until(lambda i=i: code_of(server.CloseSession, session_id=name(i)) != grpc.StatusCode.UNAVAILABLE)
            if restarts:
                server.restart()
        until(lambda: code_of(server.OpenSession, **alike(0)) == grpc.StatusCode.OK)
        assert server.Act(**acting(0, 0, 0)).durable_decision == 1


def test_a_session_that_a_full_disk_refuses_is_not_in_the_store(disk):
    with Restartable(f"file:{disk}/store") as server:
        filler = fill(disk)
        refused = []
        for i in range(MOST_SESSIONS):
            code = code_of(server.OpenSession, **opening(i) | {"durability": ["ASYNC", "SYNC"][i % 2]})
            refused += [i] if code == grpc.StatusCode.UNAVAILABLE else []
            if len(refused) == 4:
                break
        assert len(refused) == 4
        filler.unlink()
        until(lambda: code_of(server.OpenSession, **opening(refused[0])) == grpc.StatusCode.OK)
        for i in refused[1:]:
            assert code_of(server.GetSession, session_id=name(i)) == grpc.StatusCode.NOT_FOUND
        server.restart()
        for i in refused[1:]:
            assert code_of(server.Act, **acting(i, 0, 0)) == grpc.StatusCode.NOT_FOUND
        assert server.Act(**acting(refused[0], 0, 0)).durable_decision == 1


def test_a_removed_lock_lets_no_second_server_in(tmp_path):
    store = tmp_path / "store"
    with running_server(flags=[f"--session_store=file:{store}"]) as addresses:
        (store / "owner.lock").unlink()
        said = refusal_at_start(f"--session_store=file:{store}")
        assert "expected a folder that no other server uses" in said
        assert addresses.agent.OpenSession(policy="cartpole", durability="SYNC").session_id


IDLE = range(8)
DAY = 86400


@pytest.fixture
def clock(tmp_path):
    return Clock(tmp_path)


@pytest.fixture(scope="module")
def undisturbed():
    return undisturbed_answers(IDLE)


@contextlib.contextmanager
def server_with(clock, tmp_path):
    """Yields a server on a file store whose sessions have decided once, and its log."""
    log = tmp_path / "log"
    with Restartable(f"file:{tmp_path}/store", log=log, prefix=clock.prefix) as server:
        for i in IDLE:
            server.OpenSession(**opening(i))
            server.Act(**acting(i, 0, 0))
        yield server, log.read_text


@pytest.mark.parametrize("jump", [25 * 3600, -56 * 365 * DAY, 400 * DAY])
def test_a_clock_that_has_jumped_when_the_server_starts(clock, tmp_path, undisturbed, jump):
    with server_with(clock, tmp_path) as (server, log):
        server.kill()
        clock.jump(jump)
        server.restart()
        for i in IDLE:
            assert comparable(server.Act(**acting(i, 0, 1))) == undisturbed[i][1]
        assert "time of day differs from that of the last record in the session store" in log()
        server.kill()
        clock.jump(-jump)
        server.restart()
        for i in IDLE:
            assert comparable(server.Act(**acting(i, 0, 2))) == undisturbed[i][2]


def test_a_clock_that_jumps_while_the_server_runs(clock, tmp_path, undisturbed):
    """One session is used afterwards; the others are as old as before."""
    used, *idle = IDLE
    with server_with(clock, tmp_path) as (server, log):
        clock.jump(25 * 3600)
        steps = itertools.count(1)
        # Abseil looks at the clock every few seconds.
        until(lambda: server.Act(**acting(used, 0, next(steps))) and "time of day has jumped" in log())
        server.restart()
        for i in idle:
            assert comparable(server.Act(**acting(i, 0, 1))) == undisturbed[i][1]
