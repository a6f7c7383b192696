# The front door. `make demo` and `make test` need nothing but a bare Debian 12 and root.
# The CMake preset that is built: `make test PRESET=clang`.
PRESET := release
BUILD := build/$(PRESET)
BIN := $(BUILD)/bin
# Lets the compiler cache serve every clone, wherever it lies.
export CCACHE_BASEDIR := $(CURDIR)
export CCACHE_NOHASHDIR := 1

SOURCES = $(shell git ls-files --cached --others --exclude-standard '*.h' '*.cc')

.PHONY: demo test test-slow build train bench sanitize format clean setup configure

demo: configure
	cmake --build $(BUILD) --target spikeserve spikectl
	deploy/demo.sh $(BIN)

test: build
	ctest --preset $(PRESET)

# The tests that `make test` leaves out because they take an hour and more: clang-tidy over the whole tree, and the
# experts over every seed of their tables.
test-slow: build
	ctest --test-dir $(BUILD) --label-regex slow --no-tests=error --output-on-failure

build: configure
	cmake --build $(BUILD)

# Trains the shipped policies anew into build/train; resumes where it was interrupted.
train: build
	train/recipes/cartpole.sh $(BIN)/spiketrain build/train

# Everything against everything, about eight minutes on an idle machine; BENCH_FLAGS="--rounds=20" for longer runs,
# "--sections engine" for a part.
bench: build
	loadtest/bench/setup.sh $(BUILD)/bench_venv
	$(BUILD)/bench_venv/bin/python loadtest/bench/bench.py --bin=$(BIN) --python=$(BUILD)/bench_venv/bin/python \
	  --json=$(BUILD)/bench.json --markdown=docs/performance.md $(BENCH_FLAGS)

# Under the address and then the thread sanitizer: sixty seconds of 1,000 sessions on 8 streams, and ten each of 64 that
# learn one head and of 64 that learn their own, while the status page and the metrics are read.
sanitize: setup
	tests/sanitizers/run.sh asan
	tests/sanitizers/run.sh tsan

format:
	clang-format -i $(SOURCES)

clean:
	rm -rf build

setup:
	deploy/setup.sh build

configure: setup
	cmake --preset $(PRESET) $(if $(VERBOSE),,--log-level=WARNING)
