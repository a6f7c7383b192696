# Targets for users and developers. `make demo` and `make test` need only a bare Debian 12 and root.
# PRESET selects the CMake preset: `make test PRESET=clang`.
PRESET := release
BUILD := build/$(PRESET)
BIN := $(BUILD)/bin
# With these, clones in different folders share the compiler cache.
export CCACHE_BASEDIR := $(CURDIR)
export CCACHE_NOHASHDIR := 1

SOURCES = $(shell git ls-files --cached --others --exclude-standard '*.h' '*.cc')

.PHONY: demo test test-slow build train bench attacks chaos soak sanitize fuzz format clean setup configure

demo: configure
	cmake --build $(BUILD) --target spikeserve spikectl
	deploy/demo.sh $(BIN)

test: build
	ctest --preset $(PRESET)

# The tests that `make test` excludes because they take hours; CONTRIBUTING.md lists them.
test-slow: build
	ctest --test-dir $(BUILD) --label-regex slow --no-tests=error --output-on-failure

build: configure
	cmake --build $(BUILD)

# Trains the shipped CartPole policy in build/train. Continues a run that was interrupted.
train: build
	train/recipes/cartpole.sh $(BIN)/spiketrain build/train

# Runs all benchmarks, which takes about eight minutes on an idle machine. BENCH_FLAGS="--rounds=20" makes the runs
# longer, "--sections engine" selects a part.
bench: build
	loadtest/bench/setup.sh $(BUILD)/bench_venv
	$(BUILD)/bench_venv/bin/python loadtest/bench/bench.py --bin=$(BIN) --python=$(BUILD)/bench_venv/bin/python \
	  --json=$(BUILD)/bench.json --markdown=docs/performance.md $(BENCH_FLAGS)

# Runs each attack of tests/attacks for 10 seconds and prints a table: memory and processor time of the server, latency of
# another client. ATTACKS_FLAGS="--seconds=60 rapid_reset" selects others.
attacks: build
	build/interop/venv/bin/python -m tests.attacks --program=$(BIN)/spikeserve $(ATTACKS_FLAGS)

# Plays 512 sessions on three replicas and one Redis that are killed, stopped and cut off all the time, and compares every
# answer with an undisturbed run. Needs root. CHAOS_FLAGS="--decisions=200" makes it shorter.
chaos: build
	ctest --test-dir $(BUILD) --output-on-failure --tests-regex '^python_client_install$$'
	SPIKESERVE_PROGRAM=$(BIN)/spikeserve PYTHONPATH=$$(echo $(BUILD)/tests/python_client-*) \
	  build/venv/bin/python -m tests.chaos $(CHAOS_FLAGS)

# Does all kinds of work for hours and prints what the server holds after each minute of it. Fails if memory grows by more
# than 1 MB a million decisions, or descriptors or threads grow. SOAK_SECONDS=1800 makes it shorter.
SOAK_SECONDS := 14400
soak: build
	SPIKESERVE_PROGRAM=$(BIN)/spikeserve SPIKELOAD_PROGRAM=$(BIN)/spikeload \
	  build/venv/bin/python -m tests.soak --seconds=$(SOAK_SECONDS)

# Runs a server with the address sanitizer, then with the thread sanitizer. Each serves over plain text and over TLS 60
# seconds with 1,000 sessions on 8 streams, 10 seconds with 64 sessions that learn a shared head, and 10 seconds with 64
# sessions that learn their own heads, while another process reads the HTTP pages. Then come the Python tests of what
# threads share. Fails on any report.
sanitize: setup
	tests/sanitizers/run.sh asan
	tests/sanitizers/run.sh tsan

# Searches with libFuzzer for inputs that break a parser or the server's invariants: FUZZ_SECONDS for each target.
FUZZ_SECONDS := 60
fuzz: setup
	tests/fuzz/run.sh $(FUZZ_SECONDS)

format:
	clang-format -i $(SOURCES)

clean:
	rm -rf build

setup:
	deploy/setup.sh build

configure: setup
	cmake --preset $(PRESET) $(if $(VERBOSE),,--log-level=WARNING)
