"""The cases of beats_bench.py."""

import dataclasses
import time
from collections.abc import Callable

ROUND_TRIPS = (0.0004, 0.01, 0.05, 0.1, 0.2)  # seconds
LOSSES = (0.0, 0.01, 0.05)
CUTS = (1, 5, 30)  # seconds
PAUSE, RESTART = 2, 1  # seconds
PLAYERS = ("calls", "openpi", "pilot", "engine")  # robots.cc; "engine" is a pilot with the engine on the robot
WAYS = ("pilot", "datagram", "twice")  # over a stream, as datagrams, and as two datagrams a step


@dataclasses.dataclass(frozen=True)
class Case:
    """What happens to robots. `name` is that of the table."""

    name: str
    round_trip: float | None = 0.05  # seconds; None: without a link, on the host of the server
    loss: float = 0.0  # share of the packets in each direction
    burst: float = 0.0  # packets that are lost together, on average; 0: each one is lost by itself
    robots: int = 1
    connections: int = 1  # of all robots
    rate: float = 50.0  # beats a second
    store: str = ""
    disturb: Callable | None = None  # of a Site, in the middle of the run
    longer: float = 0.0  # seconds that the run takes more
    seconds: float | None = None  # None: as the command line says
    on_request: bool = False  # only run if --rows names it
    prefix: tuple = ()  # of the commands of robots and servers
    server_prefix: tuple = ()  # of the commands of servers
    players: tuple = PLAYERS


def cut(seconds):
    def disturb(site):
        site.link.order("cut")
        time.sleep(seconds)
        site.link.order("heal")

    return disturb


def pause(site):
    site.servers[0].stop()
    time.sleep(PAUSE)
    site.servers[0].resume()


def restart(site):
    site.servers[0].kill()
    time.sleep(RESTART)
    site.servers[0].start()


def fail_over(site):
    """Kills one server after the other: the session was at one of them."""
    for server in site.servers:
        server.kill()
        time.sleep(RESTART)
        server.start()
        time.sleep(RESTART)


def name_of(round_trip, loss):
    return f"{1000 * round_trip:g} ms" + (f", {loss:.0%} lost" if loss else "")


LINKS = [Case(name_of(r, loss), round_trip=r, loss=loss) for r in ROUND_TRIPS for loss in LOSSES]
DATAGRAM_LINKS = [
    *(
        Case(f"{name_of(r, loss)}, stream and datagrams", round_trip=r, loss=loss, players=WAYS)
        for r, loss in ((0.05, 0.0), (0.05, 0.01), (0.05, 0.05), (0.1, 0.01), (0.2, 0.01))
    ),
    Case("50 ms, 5% lost in bursts of 3, stream and datagrams", loss=0.05, burst=3, players=WAYS),
]
EVENTS = [
    *(Case(f"link cut for {seconds} s", disturb=cut(seconds), longer=seconds) for seconds in CUTS),
    Case("connection forgotten by a NAT", disturb=lambda site: site.link.order("forget")),
    Case(f"server paused for {PAUSE} s", disturb=pause),
    Case(f"server killed, started {RESTART} s later", disturb=restart, store="file"),
    Case("two servers, killed in turn", disturb=fail_over, store="redis", players=("calls", "pilot", "engine")),
]
HOST = "one host"
# As for a controller in real time: no other program delays them, and no processor has to wake another one.
ONE_CORE = ("taskset", "--cpu-list", "0")
REAL_TIME = (*ONE_CORE, "chrt", "--fifo", "50")
FLEETS = [
    Case(f"1 robot, 1000 Hz, {HOST}", None, rate=1000, players=("pilot", "datagram")),
    Case(f"64 robots, 100 Hz, {HOST}", None, robots=64, connections=64, rate=100, players=("pilot",)),
    Case(
        f"64 robots, 50 Hz, {HOST}, server on one core",
        None,
        robots=64,
        connections=64,
        players=("pilot", "datagram"),
        server_prefix=ONE_CORE,
    ),
    Case("64 robots, 100 Hz, 50 ms, 1% lost", loss=0.01, robots=64, connections=64, rate=100, players=("pilot",)),
    Case(f"512 robots, 50 Hz, 16 connections, {HOST}", None, robots=512, connections=16, players=("pilot",)),
    *(
        Case(name, None, rate=1000, seconds=600, on_request=True, prefix=prefix, players=("pilot",))
        for name, prefix in (
            (f"1 robot, 1000 Hz, {HOST}, ten minutes", ()),
            (f"1 robot, 1000 Hz, {HOST}, one core, real-time priority, ten minutes", REAL_TIME),
        )
    ),
]
CASES = [*LINKS, *DATAGRAM_LINKS, *EVENTS, *FLEETS]
