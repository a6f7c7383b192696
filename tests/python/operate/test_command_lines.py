"""Runs the programs as an operator does: flags from the environment and from files, help, manual pages, completion."""

import concurrent.futures
import functools
import os
import pathlib
import pty
import re
import select
import subprocess
import time

import pytest

from serving import DEADLINE_SECONDS, SHIPPED_POLICIES

SHARE = pathlib.Path(os.environ["SPIKESERVE_SHARE"])
PROGRAMS = {
    name: os.environ[f"{name.upper()}_PROGRAM"]
    for name in ("spikeserve", "spikectl", "spikeload", "spiketrain")
    if f"{name.upper()}_PROGRAM" in os.environ
}
needs_spiketrain = pytest.mark.skipif("spiketrain" not in PROGRAMS, reason="without libtorch")


def run(program, *arguments, **variables):
    """Runs a program to its end with more environment variables."""
    return subprocess.run(
        [PROGRAMS[program], *arguments],
        env=os.environ | variables,
        capture_output=True,
        text=True,
        timeout=DEADLINE_SECONDS,
        check=False,
    )


@functools.cache
def help_of(program, *path):
    """Returns the finished --help of a command, which runs once: a program with libtorch takes a second to start."""
    return run(program, *path, "--help")


def commands(program):
    """Returns the arguments that name each command of a program, [] for the program itself."""
    found = [[]]
    for path in found:
        listed = help_of(program, *path).stdout.partition("\nCommands:\n")[2].partition("\n\n")[0]
        found += [[*path, line.split()[0]] for line in listed.splitlines()]
    return found


COMMANDS = [(program, path) for program in PROGRAMS for path in commands(program)]


def started_on(*arguments, **variables):
    """Returns the host on which a server with these flags and variables listens."""
    with subprocess.Popen(
        [PROGRAMS["spikeserve"], *arguments], env=os.environ | variables, stdout=subprocess.PIPE, text=True
    ) as server:
        line = server.stdout.readline()
        server.terminate()
        server.stdout.read()
    assert server.returncode == 0
    return re.fullmatch(r"spikeserve: serving gRPC on (.*):\d+\n", line)[1]


def test_the_server_takes_flags_from_the_command_line_the_environment_and_a_file(tmp_path):
    config = tmp_path / "spikeserve.toml"
    config.write_text(f'policies = "{SHIPPED_POLICIES}"\nlisten = "127.0.0.1:0"\nhttp_listen = ""\nsession_ttl = "2m"\n')
    assert started_on(f"--config={config}") == "127.0.0.1"
    variables = {"SPIKESERVE_CONFIG": str(config), "SPIKESERVE_LISTEN": "127.0.0.2:0"}
    assert started_on(**variables) == "127.0.0.2"
    assert started_on("--listen=127.0.0.3:0", **variables) == "127.0.0.3"


def test_an_empty_variable_sets_the_empty_value():
    variables = {"SPIKESERVE_LISTEN": "127.0.0.1:0", "SPIKESERVE_HTTP_LISTEN": ""}
    with subprocess.Popen(
        [PROGRAMS["spikeserve"], f"--policies={SHIPPED_POLICIES}"],
        env=os.environ | variables,
        stdout=subprocess.PIPE,
        text=True,
    ) as server:
        assert "serving gRPC" in server.stdout.readline()
        server.terminate()
        assert server.stdout.read() == "", "the server serves no HTTP"
    failed = run("spikeserve", SPIKESERVE_SESSION_TTL="")
    assert failed.stderr.startswith("spikeserve: SPIKESERVE_SESSION_TTL: --session_ttl: expected a duration such as ")


def test_the_server_names_the_variable_or_the_file_of_a_wrong_value(tmp_path):
    expected = 'expected a duration such as 250ms, 10s or 1.5m, received "soon"'
    failed = run("spikeserve", SPIKESERVE_SESSION_TTL="soon")
    assert (failed.returncode, failed.stderr) == (
        1,
        f"spikeserve: SPIKESERVE_SESSION_TTL: --session_ttl: {expected}\n",
    )
    config = tmp_path / "spikeserve.toml"
    config.write_text("session_ttl = soon\n")
    assert run("spikeserve", f"--config={config}").stderr == f"spikeserve: {config}: --session_ttl: {expected}\n"
    config.write_text("sesion_ttl = 2m\n")
    failed = run("spikeserve", f"--config={config}")
    assert failed.stderr == f'spikeserve: {config}: expected flags of spikeserve, received "sesion_ttl"\n'


@pytest.mark.parametrize(("program", "arguments"), [("spikectl", ["run"]), ("spikeload", [])])
def test_the_clients_take_the_server_from_the_environment_and_a_file(program, arguments, tmp_path):
    config = tmp_path / "client.ini"
    config.write_text("server = 127.0.0.1:1\n")
    from_file = {f"{program.upper()}_CONFIG": str(config)}
    from_variable = from_file | {f"{program.upper()}_SERVER": "127.0.0.1:2"}
    runs = [(1, (), from_file), (2, (), from_variable), (3, ("--server=127.0.0.1:3",), from_variable)]
    with concurrent.futures.ThreadPoolExecutor() as threads:  # each waits for its server
        failed = [threads.submit(run, program, *arguments, *flags, **variables) for _, flags, variables in runs]
        for (port, *_), each in zip(runs, failed, strict=True):
            assert f"no server could be reached at 127.0.0.1:{port}" in each.result().stderr
            assert each.result().stderr.count("\n") == 1


def test_a_section_of_a_file_holds_the_flags_of_a_command(tmp_path):
    config = tmp_path / "spikectl.toml"
    config.write_text('[run]\nepisodes = 0\n[admin.label]\nlabel = "stable"\n')
    expected = "spikectl: --episodes: expected at least 1, received 0 (INVALID_ARGUMENT)\n"
    assert run("spikectl", "run", f"--config={config}").stderr == expected
    config.write_text("episodes = 3\n")
    assert 'expected flags of spikectl, received "episodes"' in run("spikectl", "run", f"--config={config}").stderr


@needs_spiketrain
def test_a_dataset_names_the_seed_of_the_environment(tmp_path):
    out = tmp_path / "data.cbor"
    recorded = run("spiketrain", "dataset", f"--out={out}", "--json", SPIKETRAIN_SEED="7", SPIKETRAIN_STEPS="50")
    assert recorded.returncode == 0, recorded.stderr
    assert '"seed": 7' in recorded.stdout
    refused = run("spiketrain", "dataset", f"--out={out}", "--recordings=x", "--steps=5")
    assert refused.stderr == "spiketrain: --steps: expected no such flag beside --recordings, received 5\n"
    refused = run("spiketrain", "eval", "--steps=5")
    assert "--steps: expected a flag of spiketrain eval" in refused.stderr


@pytest.mark.parametrize("program", PROGRAMS)
def test_every_program_has_one_version(program):
    printed = run(program, "--version").stdout
    assert re.fullmatch(rf"{program} \d+\.\d+\.\d+\n", printed)
    assert printed.split()[1] == run("spikeserve", "--version").stdout.split()[1]


@pytest.mark.parametrize(("program", "path"), COMMANDS, ids=lambda value: " ".join(value) if value else "-")
def test_help_fits_the_screen(program, path):
    printed = help_of(program, *path)
    assert printed.returncode == 0
    lines = printed.stdout.splitlines()
    assert max(map(len, lines)) <= 100
    if program != "spiketrain":  # whose training has three dozen flags
        assert len(lines) <= 44
    assert lines[1] == " ".join(["Usage:", program, *path, *["COMMAND"] * ("Commands:" in lines), "[--FLAG=VALUE ...]"])


@pytest.mark.parametrize("program", PROGRAMS)
def test_the_manual_page_is_well_formed_and_complete(program):
    page = SHARE / "man/man1" / f"{program}.1"
    lint = subprocess.run(["mandoc", "-T", "lint", "-W", "warning", page], capture_output=True, text=True, check=False)
    assert (lint.returncode, lint.stdout) == (0, "")
    text = subprocess.run(["mandoc", "-T", "ascii", page], capture_output=True, text=True, check=True).stdout
    text = re.sub(".\b", "", text)
    for _, path in (entry for entry in COMMANDS if entry[0] == program):
        assert " ".join([program, *path]) in text
        for flag in re.findall(r"^  (--\w+)", help_of(program, *path).stdout, re.MULTILINE):
            assert flag in text


class Terminal:
    """An interactive shell in a terminal."""

    def __init__(self, argv, setup):
        self._pid, self._terminal = pty.fork()
        if self._pid == 0:
            os.execvpe(argv[0], argv, os.environ | {"TERM": "xterm", "PS1": "", "HISTFILE": ""})
        self._output = ""
        self._send(f"{setup}; echo READY-$((1 + 1))\n")
        self._wait_for("READY-2")

    def complete(self, line):
        """Returns the command line after the key Tab: sent to echo, which prints it behind a mark."""
        self._send(f"{line}\t\x01echo MARK-$((1 + 1)) '\x05'\n")
        return self._wait_for(r"MARK-2 ([^\r\n]*)\r?\n")[1]

    def close(self):
        os.close(self._terminal)
        os.waitpid(self._pid, 0)

    def _send(self, keys):
        os.write(self._terminal, keys.encode())

    def _wait_for(self, pattern):
        deadline = time.monotonic() + DEADLINE_SECONDS
        while not (found := re.search(pattern, self._output)):
            readable, _, _ = select.select([self._terminal], [], [], deadline - time.monotonic())
            assert readable, f"no {pattern} in {self._output}"
            self._output += os.read(self._terminal, 4096).decode(errors="replace")
        self._output = self._output[found.end() :]
        return found


@pytest.fixture(params=["bash", "zsh"])
def terminal(request, tmp_path, monkeypatch):
    (tmp_path / "episodes.cbor").touch()
    monkeypatch.chdir(tmp_path)
    if request.param == "bash":
        scripts = SHARE / "bash-completion/completions"
        started = Terminal(["bash", "--norc", "--noprofile", "-i"], f"for script in {scripts}/*; do . $script; done")
    else:
        functions = SHARE / "zsh/site-functions"
        setup = f"fpath=({functions} $fpath); autoload -U compinit; compinit -u -D"
        started = Terminal(["zsh", "-f", "-i"], setup)
    yield started
    started.close()


def test_the_shell_completes_commands_flags_and_values(terminal):
    for line, completed in (
        ("spikectl adm", "spikectl admin"),
        ("spikectl admin unlo", "spikectl admin unload"),
        ("spikectl run --en", "spikectl run --env"),
        ("spikectl run --serv", "spikectl run --server"),
        ("spikectl adapt --scope=fl", "spikectl adapt --scope=fleet"),
        ("spikectl adapt --scope fl", "spikectl adapt --scope fleet"),
        ("spikectl replay --recording=epi", "spikectl replay --recording=episodes.cbor"),
        ("spikeload --mode=str", "spikeload --mode=stream"),
        ("spikeserve --insec", "spikeserve --insecure_network"),
    ):
        assert terminal.complete(line).rstrip(" =") == completed  # zsh takes "=" back when no value follows


def test_fish_completes_commands_flags_and_values():
    script = SHARE / "fish/vendor_completions.d/spikectl.fish"
    for line, completed in (
        ("spikectl adm", ["admin"]),
        ("spikectl admin unlo", ["unload"]),
        ("spikectl run --en", ["--env"]),
        ("spikectl run --serv", ["--server"]),
        ("spikectl adapt --scope fl", ["fleet"]),
        ("spikectl policies --en", []),
    ):
        listed = subprocess.run(
            ["fish", "--no-config", "-c", f"source {script}; complete -C '{line}'"],
            capture_output=True,
            text=True,
            check=True,
        )
        assert [row.split("\t")[0] for row in listed.stdout.splitlines()] == completed


def test_a_variable_that_belongs_to_no_flag_is_refused():
    refused = run("spikeserve", "--policies=/nowhere", SPIKESERVE_LISTN="[::1]:0")
    assert refused.returncode == 1
    assert refused.stderr == (
        "spikeserve: environment: expected variables of flags, such as SPIKESERVE_LISTEN, "
        "received SPIKESERVE_LISTN\n"
    )
    assert "SPIKECTL_SEVRER" in run("spikectl", "policies", SPIKECTL_SEVRER="x").stderr
    assert run("spikeserve", "--help", SPIKESERVE_LISTN="x").returncode == 0


def test_variables_of_kubernetes_and_of_clients_are_allowed():
    others = {
        "SPIKESERVE_TOKEN": "secret",
        "SPIKESERVE_SERVER": "127.0.0.1:50051",
        "SPIKESERVE_SERVICE_HOST": "10.0.0.1",
        "SPIKESERVE_SERVICE_PORT": "50051",
        "SPIKESERVE_SERVICE_PORT_GRPC": "50051",
        "SPIKESERVE_PORT": "tcp://10.0.0.1:50051",
        "SPIKESERVE_PORT_50051_TCP_ADDR": "10.0.0.1",
    }
    arguments = [f"--policies={SHIPPED_POLICIES}", "--listen=127.0.0.1:0", "--http_listen="]
    assert started_on(*arguments, **others) == "127.0.0.1"
