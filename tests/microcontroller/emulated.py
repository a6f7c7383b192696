"""Compiles the C of policies for microcontrollers, and runs it in QEMU."""

import subprocess
from dataclasses import dataclass

from emitted import run

ARM = "arm-none-eabi-"
RISCV = "riscv64-unknown-elf-"
LARGE = (0x00000000, 4 << 20, 0x20000000, 4 << 20)  # flash and RAM of mps2
SCRIPT = """
ENTRY(reset)
MEMORY {{ flash (rx): ORIGIN = {}, LENGTH = {}  ram (rwx): ORIGIN = {}, LENGTH = {} }}
SECTIONS {{
  .text : {{ KEEP(*(.reset)) *(.text* .rodata* .srodata*) }} > flash
  .ARM.exidx : {{ *(.ARM.exidx*) }} > flash
  .data : {{ *(.data* .sdata*) }} > ram
  .bss : {{ *(.bss* .sbss* COMMON) . = ALIGN(16); stack_bottom = .; }} > ram
  stack_top = ORIGIN(ram) + LENGTH(ram);
}}
"""


@dataclass
class Chip:
    """A processor, and the machine of QEMU that has it."""

    prefix: str
    flags: list
    machine: list
    clock: int  # of SysTick, in Hz
    memory: tuple = LARGE
    bytes_of_none: int | None = None

    def link(self, emitted, level, **sources):
        """Returns the program of a policy for this chip."""
        script = emitted.folder / "chip.ld"
        script.write_text(SCRIPT.format(*self.memory))
        flags = [*self.flags, level, f"-DTICK={1e9 / self.clock}", "-ffunction-sections"]
        flags += ["-nostartfiles", f"-T{script}", "-Wl,--gc-sections"]
        return emitted.compile([self.prefix + "gcc"], *flags, port="port_emulator.c", out=f"play{level}", **sources)

    def flash(self, emitted, program="calls_all.c"):
        """Returns the bytes of the seven functions, their tables, and what they need of the compiler's library."""
        if self.bytes_of_none is None:
            self.bytes_of_none = self._size(emitted, "calls_none.c")  # the same for every policy
        return self._size(emitted, program) - self.bytes_of_none

    def _size(self, emitted, program):
        linked = self.link(emitted, "-Os", program=program)
        return sum(map(int, run(self.prefix + "size", linked).splitlines()[1].split()[:2]))

    def command(self, program, *options):
        """Returns what emulates a program, in the folder that has its stream."""
        command = [*self.machine, "-display", "none", "-serial", "none", "-monitor", "none", *options]
        return [*command, "-semihosting-config", "enable=on,target=native", "-kernel", program.name]

    def run(self, emitted, level, counts=True, **sources):
        """Returns the hash, and what else chip_play.c prints, in hexadecimal. Instructions are counted at half the speed."""
        command = self.command(self.link(emitted, level, **sources), *(["-icount", "shift=0"] if counts else []))
        done = subprocess.run(command, cwd=emitted.folder, capture_output=True, text=True)
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stderr.split() or done.stdout.split()


def arm(cpu, machine, *flags, clock=25_000_000, memory=LARGE):
    flags = [f"-mcpu={cpu}", "-mthumb", *flags, "--specs=nosys.specs"]
    return Chip(ARM, flags, ["qemu-system-arm", "-M", machine], clock, memory)


CHIPS = {
    # Code for the M0+ also runs on the M3 of a machine with more memory than the M0's 16 KB.
    "cortex-m0plus": arm("cortex-m0plus", "mps2-an385"),
    "cortex-m4": arm("cortex-m4", "mps2-an386", "-mfloat-abi=hard", "-mfpu=fpv4-sp-d16"),
    "cortex-m7": arm("cortex-m7", "mps2-an500", "-mfloat-abi=hard", "-mfpu=fpv5-d16"),
    "cortex-m33": arm(
        "cortex-m33",
        "mps2-an505",
        "-mfloat-abi=hard",
        "-mfpu=fpv5-sp-d16",
        clock=20_000_000,
        memory=(0x10000000, 4 << 20, 0x38000000, 4 << 20),
    ),
    "cortex-m55": arm(
        "cortex-m55",
        "mps3-an547",
        "-mfloat-abi=hard",
        clock=32_000_000,
        memory=(0x00000000, 512 << 10, 0x21000000, 2 << 20),
    ),
    "rv32imc": Chip(
        RISCV,
        ["-march=rv32imc", "-mabi=ilp32", "-mcmodel=medany", "--specs=picolibc.specs"],
        ["qemu-system-riscv32", "-M", "virt", "-bios", "none"],
        clock=1_000_000_000,
        memory=(0x80000000, 4 << 20, 0x80400000, 4 << 20),
    ),
}
# Compilers, and the emulator of what they make, of processors with an operating system: undefined behaviour is found, words have
# 32 bits, and the most significant byte comes first, which QEMU's Cortex-M cannot.
HOSTS = {
    "undefined": (["gcc", "-O1", "-fsanitize=undefined", "-fno-sanitize-recover=all"], []),
    "32-bits": (["i686-linux-gnu-gcc", "-O2", "-msse2", "-mfpmath=sse", "-static"], []),
    "big-endian": (["powerpc-linux-gnu-gcc", "-O2", "-static"], ["qemu-ppc-static"]),
}
MICROBIT = arm("cortex-m0plus", "microbit", clock=16_000_000, memory=(0, 256 << 10, 0x20000000, 16 << 10))
