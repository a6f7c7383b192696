"""The C of every shipped policy, and of random ones, decides on this machine as the server does, bit for bit."""

import json
import re
import subprocess

import pytest
from emitted import C99, CHIP_STREAM, FORMAT, ROOT, SPIKECTL, emit, name_of, play, run, shipped

SANITIZED = ["-O1", "-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all"]


@pytest.mark.parametrize("file", shipped(), ids=name_of)
def test_shipped_policies(file, tmp_path):
    emitted = emit(file, tmp_path, decisions=150)
    assert play(emitted, emitted.compile(["gcc"], *SANITIZED)) == emitted.hash


@pytest.mark.parametrize("number", [0x00, 0x53, 0xAD, 0x6E, 0xF1, 0xFF])
def test_random_policies(number, tmp_path):
    run(CHIP_STREAM, "random", number, tmp_path / "random.safetensors")
    emitted = emit(tmp_path / "random.safetensors", tmp_path, decisions=150)
    assert play(emitted, emitted.compile(["gcc"], *SANITIZED)) == emitted.hash


def test_a_thousand_moves(tmp_path):
    """Sessions go to the C and back to the server in mid-episode; the hash has every value that goes back."""
    emitted = emit(shipped()[0], tmp_path, decisions=20_000)
    calls = emitted.stream.read_bytes().count(b"spikeserve.session.v1")
    assert calls > 1000
    assert play(emitted, emitted.compile(["gcc"], "-O2")) == emitted.hash


def values_of(stream):
    """Returns where the values that are imported begin and end."""
    for found in re.finditer(re.escape(FORMAT), stream):
        at = found.start()
        yield at, at + int.from_bytes(stream[at - 4 : at], "little")


def checksum(value):
    hashed = 0xCBF29CE484222325
    for byte in value:
        hashed = (hashed ^ byte) * 0x100000001B3 % (1 << 64)
    return hashed.to_bytes(8, "little")


def with_more(value, more, items=1):
    """Returns a session's value with more items behind the 17 that every server writes."""
    count = bytes([0x80 + 17 + items]) if 17 + items < 24 else bytes([0x98, 17 + items])
    value = FORMAT + count + value[len(FORMAT) + 1 : -8] + more
    return value + checksum(value)


# {"wiring": [1, -2, 1.5, 0.5, null, true, []]}, with 1.5 as a float32 and 0.5 as a float64
LATER = bytes.fromhex("a1 66 776972696e67 87 01 21 fa3fc00000 fb3fe0000000000000 f6 f5 80")


def test_values_of_later_servers(tmp_path):
    """What the C does not know it skips, and decides the same."""
    emitted = emit(shipped()[0], tmp_path, decisions=400)
    stream, longer, end = emitted.stream.read_bytes(), b"", 0
    for first, last in values_of(stream):
        value = with_more(stream[first:last], LATER)
        longer += stream[end : first - 4] + len(value).to_bytes(4, "little") + value
        end = last
    emitted.stream.write_bytes(longer + stream[end:])
    program = emitted.compile(["gcc"], *SANITIZED)
    assert play(emitted, program) == emitted.hash
    # An item that is cut off, one that has no end, and more of them than a value may have.
    for more, items in ((LATER[:-1], 1), (bytes.fromhex("9bffffffffffffffff"), 1), (b"\xf6" * 16, 16)):
        value = with_more(stream[first:last], more, items)
        emitted.stream.write_bytes(b"I" + len(value).to_bytes(4, "little") + value)
        with pytest.raises(subprocess.CalledProcessError) as refused:
            play(emitted, program)
        assert refused.value.stdout == "spike_import\n"


def test_damaged_values(tmp_path):
    emitted = emit(shipped()[0], tmp_path, decisions=400)
    stream = emitted.stream.read_bytes()
    *_, (first, last) = values_of(stream)
    (tmp_path / "value").write_bytes(with_more(stream[first:last], LATER))
    program = emitted.compile(["gcc"], *SANITIZED, program="value_fuzz.c", port=None, out="fuzz")
    print(run(program, tmp_path / "value"))


def test_no_heap_and_no_libm(tmp_path):
    emitted = emit(shipped()[0], tmp_path, decisions=1)
    run("gcc", *C99, "-Os", "-c", emitted.folder / "spike_policy.c", "-o", tmp_path / "policy.o")
    needed = {line.split()[-1] for line in run("nm", "-u", tmp_path / "policy.o").splitlines()}
    assert needed <= {"memcpy", "memset", "memcmp", "strlen", "__stack_chk_fail", "_GLOBAL_OFFSET_TABLE_"}


def refusal(*flags):
    done = subprocess.run([SPIKECTL, "emit-c", *map(str, flags)], capture_output=True, text=True)
    assert done.returncode != 0
    return done.stderr


def with_environment(file, environment):
    """Returns the bytes of a policy file with another environment."""
    content = file.read_bytes()
    size = int.from_bytes(content[:8], "little")
    header = json.loads(content[8 : 8 + size])
    header["__metadata__"]["environment"] = environment
    header = json.dumps(header).encode()
    header += b" " * (-len(header) % 8)
    return len(header).to_bytes(8, "little") + header + content[8 + size :]


def test_texts_of_others(tmp_path):
    """The longest name fits the value of a session, and no environment becomes code."""
    file = tmp_path / ("n" * 128 + ".safetensors")
    file.write_bytes(with_environment(shipped()[0], "x */ int y; #error /* /*/"))
    emitted = emit(file, tmp_path, decisions=150)
    assert play(emitted, emitted.compile(["gcc"], *SANITIZED)) == emitted.hash


def test_refusals(tmp_path):
    float32 = ROOT / "tests/releases/0.1.0/policies/cartpole-sparse/1/policy.safetensors"
    small = shipped()[0]
    assert "spiketrain quantize --policy=FILE --to=integer" in refusal(f"--policy={float32}", f"--out={tmp_path}/c")
    assert "--ram: expected at least 3944 bytes" in refusal(f"--policy={small}", f"--out={tmp_path}/c", "--ram=3000")
    long = tmp_path / ("n" * 129 + ".safetensors")
    long.write_bytes(small.read_bytes())
    assert re.search(
        r": name: expected at most 128 bytes of printable characters, received \"n+\.\.\.\" of 129 bytes",
        refusal(f"--policy={long}", f"--out={tmp_path}/c"),
    )
    assert "--policy: expected a policy file" in refusal(f"--out={tmp_path}/c")
    assert "--kind: expected plain, arduino or zephyr" in refusal(
        f"--policy={small}", f"--out={tmp_path}/c", "--kind=x"
    )
    assert not (tmp_path / "c").exists()
