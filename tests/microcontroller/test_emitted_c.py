"""The C of every shipped policy, and of random ones, decides on this machine as the server does, bit for bit."""

import subprocess

import pytest
from emitted import C99, CHIP_STREAM, ROOT, SPIKECTL, emit, name_of, play, run, shipped

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


def test_damaged_values(tmp_path):
    emitted = emit(shipped()[0], tmp_path, decisions=400)
    stream = emitted.stream.read_bytes()
    at = stream.rindex(b"spikeserve.session.v1") - 2
    size = int.from_bytes(stream[at - 4 : at], "little")
    (tmp_path / "value").write_bytes(stream[at : at + size])
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


def test_refusals(tmp_path):
    float32 = ROOT / "tests/releases/0.1.0/policies/cartpole-sparse/1/policy.safetensors"
    small = shipped()[0]
    assert "spiketrain quantize --policy=FILE --to=integer" in refusal(f"--policy={float32}", f"--out={tmp_path}/c")
    assert "--ram: expected at least 3816 bytes" in refusal(f"--policy={small}", f"--out={tmp_path}/c", "--ram=3000")
    assert "--policy: expected a policy file" in refusal(f"--out={tmp_path}/c")
    assert "--kind: expected plain, arduino or zephyr" in refusal(
        f"--policy={small}", f"--out={tmp_path}/c", "--kind=x"
    )
    assert not (tmp_path / "c").exists()


def test_libraries(tmp_path):
    for kind, expected in (("arduino", "library.properties"), ("zephyr", "zephyr/module.yml")):
        run(SPIKECTL, "emit-c", f"--policy={shipped()[0]}", f"--out={tmp_path / kind}", f"--kind={kind}")
        assert (tmp_path / kind / expected).exists()
        assert (tmp_path / kind / "spike_policy.c").exists()
