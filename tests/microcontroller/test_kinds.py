"""The library for Arduino and the module for Zephyr build with their examples. What these systems declare stands here."""

import os

from emitted import C99, ROOT, SPIKECTL, run, shipped

EXAMPLES = ROOT / "examples/microcontroller"
ARDUINO = """
#include <stddef.h>
#include <stdint.h>
struct Stream {
  void begin(unsigned long);
  size_t readBytes(char*, size_t);
  size_t write(const uint8_t*, size_t);
};
extern Stream Serial;
"""
DEVICE = """
struct device { int number; };
extern const struct device console;
#define DT_CHOSEN(name) name
#define DEVICE_DT_GET(node) (&console)
"""
UART = """
int uart_poll_in(const struct device*, unsigned char*);
void uart_poll_out(const struct device*, unsigned char);
"""
# An application is linked with each module; here its objects are only compiled.
ZEPHYR = """
add_library(app OBJECT)
function(zephyr_library_named name)
  add_library(${name} OBJECT)
  set(ZEPHYR_CURRENT_LIBRARY ${name} PARENT_SCOPE)
endfunction()
macro(zephyr_library_sources)
  target_sources(${ZEPHYR_CURRENT_LIBRARY} PRIVATE ${ARGN})
endmacro()
macro(zephyr_include_directories)
  target_include_directories(app PRIVATE ${CMAKE_CURRENT_SOURCE_DIR}/${ARGN})
endmacro()
target_include_directories(app PRIVATE ${Zephyr_DIR})
enable_language(C)
foreach(module ${EXTRA_ZEPHYR_MODULES})
  file(STRINGS ${module}/zephyr/module.yml folder REGEX "cmake: ")
  string(REGEX REPLACE ".*cmake: " "" folder ${folder})
  add_subdirectory(${module}/${folder} module)
endforeach()
"""


def emit(tmp_path, kind):
    run(SPIKECTL, "emit-c", f"--policy={shipped()[0]}", f"--out={tmp_path}/firmware", f"--kind={kind}")
    return tmp_path / "firmware"


def test_arduino(tmp_path):
    library = emit(tmp_path, "arduino")
    properties = dict(line.split("=", 1) for line in (library / "library.properties").read_text().splitlines())
    assert properties["includes"] == "spike_policy.h"
    (tmp_path / "Arduino.h").write_text(ARDUINO)
    sketch = EXAMPLES / "arduino/arduino.ino"
    flags = ["-Wall", "-Wextra", "-Werror", f"-I{library}", "-include", tmp_path / "Arduino.h", "-x", "c++"]
    run("g++", "-std=c++11", *flags, "-c", sketch, "-o", tmp_path / "sketch.o")
    run("gcc", *C99, "-c", library / "spike_policy.c", "-o", tmp_path / "policy.o")


def test_zephyr(tmp_path):
    module = emit(tmp_path, "zephyr")
    zephyr = tmp_path / "base"
    for name, text in (("ZephyrConfig.cmake", ZEPHYR), ("zephyr/device.h", DEVICE), ("zephyr/drivers/uart.h", UART)):
        (zephyr / name).parent.mkdir(parents=True, exist_ok=True)
        (zephyr / name).write_text(text)
    flags = [f"-DEXTRA_ZEPHYR_MODULES={module}", "-DCMAKE_C_FLAGS=-Wall -Wextra -Werror", f"-DZephyr_DIR={zephyr}"]
    environment = os.environ | {"ZEPHYR_BASE": str(zephyr)}
    run("cmake", "-S", EXAMPLES / "zephyr", "-B", tmp_path / "build", *flags, env=environment)
    run("cmake", "--build", tmp_path / "build")
