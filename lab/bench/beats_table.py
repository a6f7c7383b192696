"""Writes the rows of beats_bench.py as tables, between the markers of two pages."""

from beats_cases import DATAGRAM_LINKS, EVENTS, FLEETS, LINKS, WAYS

BEGIN, END = "<!-- make lab-beats -->\n", "<!-- end of make lab-beats -->"
EVIDENCE, ANSWER = "lab/evidence/missed-beats.md", "docs/guides/how-far.md"
NAMES = {
    "calls": "`act` at every beat",
    "openpi": "openpi-client 0.1.2",
    "pilot": "pilot",
    "engine": "pilot with engine",
}
WAY_NAMES = {"pilot": "pilot over a stream", "datagram": "pilot, datagrams", "twice": "pilot, each datagram twice"}
HEADER = [
    *("robot", "without fresh action", "held", "local", "safe", "no action", "stale", "doubled", "undefined"),
    *("age p50", "p99", "p99.9", "longest without fresh", "return"),
]
FLEET_HEADER = [
    *("robots", "without fresh action", "held", "safe", "no action", "stale", "doubled", "undefined"),
    *("age p50", "p99", "p99.9", "longest without fresh", "beats played", "server, a beat"),
]


def share(row, count):
    total = row["beats"] + row["none"]
    return f"{100 * count / total:.1f} %" if count else "0"


def shares(row, names):
    missed = row["beats"] + row["none"] - row["fresh"]
    return [share(row, missed), *(share(row, row.get(name, 0)) for name in names)]


def counts(row):
    return [str(row.get(name, "")) for name in ("stale", "doubled", "undefined")]


def times(row):
    has_ages = row["p50"] > 0
    ages = [f"{1000 * row[name]:.2g} ms" if row[name] < 0.01 else f"{1000 * row[name]:.0f} ms" for name in ("p50", "p99", "p999")]
    return [*(ages if has_ages else [""] * 3), f"{row['longest']:.2f} s"]


def table(header, rows):
    lines = ["| " + " | ".join(header) + " |", "| --- |" + " ---: |" * (len(header) - 1)]
    return "\n".join(lines + ["| " + " | ".join(row) + " |" for row in rows]) + "\n"


def case_table(cases, finished, names=NAMES):
    rows = []
    for case in cases:
        played = [(name, finished[f"{case.name}: {name}"]) for name in case.players if f"{case.name}: {name}" in finished]
        if played:
            rows.append([f"**{case.name}**", *[""] * (len(HEADER) - 1)])
        for name, row in played:
            returned = "" if row["return"] is None else f"{row['return']:.0f}"
            rungs = shares(row, ("held", "local", "safe", "none"))
            rows.append([names[name], *rungs, *counts(row), *times(row), returned])
    return table(HEADER, rows)


def fleet_table(finished):
    rows = []
    for case in FLEETS:
        for player in case.players:
            if (row := finished.get(f"{case.name}: {player}")) is None:
                continue
            name = case.name if player == "pilot" else f"{case.name}, datagrams"
            rate = share(row | {"beats": case.robots * case.rate * row["seconds"], "none": 0}, row["beats"])
            cost = f"{1e6 * row['server_seconds']:.0f} µs" if "server_seconds" in row else ""
            rows.append([name, *shares(row, ("held", "safe", "none")), *counts(row), *times(row), rate, cost])
    return table(FLEET_HEADER, rows)


def all_tables(finished):
    """Returns what EVIDENCE has between its markers."""
    machines = sorted({row["machine"] for row in finished.values()})
    loads = [row["load"] for row in finished.values()]
    measured = f"Machine: {'; '.join(machines)}. Its load average was {min(loads):.1f} to {max(loads):.1f}.\n"
    parts = [
        *(measured, "### Delay and loss, 50 Hz\n", case_table(LINKS, finished)),
        *("### Stream and datagrams, 50 Hz\n", case_table(DATAGRAM_LINKS, finished, WAY_NAMES)),
        *("### Events, 50 Hz, 50 ms\n", case_table(EVENTS, finished)),
        *("### Fleets, pilots without engine\n", fleet_table(finished)),
    ]
    return "\n" + "\n".join(parts) + "\n"


def answer_table(finished):
    """Returns what ANSWER has between its markers."""
    rows = []
    for case in [*LINKS, *EVENTS]:
        played = {name: finished.get(f"{case.name}: {name}") for name in NAMES}
        if played["pilot"] is not None:
            missed = [row and shares(row, ())[0] or "" for row in played.values()]
            age, engine = times(played["pilot"])[0], played["engine"]
            rows.append([case.name, *missed, age, f"{engine['return']:.0f}" if engine else ""])
    return table(["round trip, or event at 50 ms", *NAMES.values(), "age, pilot", "return, engine"], rows) + way_table(finished)


def way_table(finished):
    """Returns what one lost packet holds back, by the way that the steps of a pilot go."""
    rows = []
    for case in DATAGRAM_LINKS:
        played = [finished.get(f"{case.name}: {name}") for name in WAYS]
        if all(played):
            ages = (times(row)[1] for row in played)
            rows.append([case.name.split(", stream")[0], *(shares(row, ())[0] for row in played), *ages])
    header = ["round trip", *WAY_NAMES.values(), *(f"age p99, {name}" for name in ("stream", "datagrams", "twice"))]
    return "\nThe same by the way that the steps of a pilot go, without an engine:\n\n" + table(header, rows) if rows else ""


def pages(root, finished):
    """Yields the path and the text of each page."""
    for name, text in ((EVIDENCE, all_tables(finished)), (ANSWER, answer_table(finished))):
        page = (root / name).read_text()
        yield root / name, page[: page.index(BEGIN) + len(BEGIN)] + text + page[page.index(END) :]
