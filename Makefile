# Targets for users and developers. Each installs what it needs by itself, on a bare Debian 12 as root with make and git.
# README.md lists what each costs.
BUILD := build/release
BIN := $(BUILD)/bin
SETUP := deploy/setup.sh build
EMPTY :=
# With these, clones in different folders share the compiler cache.
export CCACHE_BASEDIR := $(CURDIR)
export CCACHE_NOHASHDIR := 1
# The compiler says which headers it has read, so that the cache need not preprocess each source first.
export CCACHE_DEPEND := 1

SOURCES = $(shell git ls-files --cached --others --exclude-standard '*.h' '*.cc')

.PHONY: demo measure-setup test test-all checked test-slow test-arm64 test-arm64-short test-chips golden build dist site reference playground bench attacks chaos trace soak \
  sanitize fuzz format clean help \
  setup configure

# Installs and builds only the server and spikectl. PLAY=1 keeps playing. A build folder that is configured already keeps its other targets.
DEMO_PROCESSOR_MINUTES := 6
demo: export NINJA_STATUS = demo: 2/3 compiling, %f of %t files after %e s: $(EMPTY)
demo:
	@echo "demo: 1/3 installing 102 packages, the first time: 119 MB to download, 1 to 3 minutes"
	@$(SETUP) server
	@echo "demo: 2/3 compiling the server and spikectl, the first time: about $$(($(DEMO_PROCESSOR_MINUTES) / $$(nproc) + 1)) minutes on the $$(nproc) processors of this machine"
	@test -e $(BUILD)/build.ninja || cmake --preset release --log-level=WARNING -DSPIKESERVE_BUILD_TESTS=OFF \
	  -DSPIKESERVE_BUILD_TRAIN=OFF -DSPIKESERVE_BUILD_PYTHON=OFF
	@cmake --build $(BUILD) --target spikeserve spikectl
	@echo "demo: 3/3 $(if $(PLAY),playing until Ctrl-C,playing 20 episodes of CartPole: a few seconds)"
	@deploy/demo.sh $(BIN)

# Runs `make demo` in a fresh root of Debian 12 and prints its packages, disk and minutes. MEASURE=test measures another target.
MEASURE ?= demo
measure-setup:
	$(SETUP) release
	deploy/measure_setup.sh $(MEASURE)

# Builds everything and runs the tests, but for those of test-all.
test: build
	$(SETUP) clang tests
	ctest --preset release

# Runs also the tests that need a browser, a proxy, Go, Node.js or a virtual machine, clang's checks, attacks and faults.
test-all: setup test
	ctest --preset release-rest

# Builds the server, its clients and the unit tests with clang, its thread analysis, and checks of what headers require, and
# runs the unit and integration tests.
checked:
	$(SETUP) server build clang tests
	cmake --preset checked $(if $(VERBOSE),,--log-level=WARNING)
	cmake --build --preset checked
	ctest --preset checked

# The tests that take hours; CONTRIBUTING.md lists them.
test-slow: build setup
	$(SETUP) chart collector ros microcontrollers
	$(MAKE) playground
	ctest --test-dir $(BUILD) --label-regex slow --no-tests=error --output-on-failure

# Cross-builds everything for arm64 and runs the tests with qemu; then plays CartPole with the installed packages and with
# the engine's wheel. The short form builds and runs what must not differ on arm64.
test-arm64: setup
	deploy/arm64_root.sh
	cmake --preset arm64 $(if $(VERBOSE),,--log-level=WARNING)
	cmake --build build/arm64
	python3 tests/arm64/suite.py
	python3 tests/arm64/packages.py
	cmake --preset release --log-level=WARNING
	cmake --build build/release --target spikeserve_python_engine_stub
	build/venv/bin/python tests/arm64/wheel.py build/release/python/spikeserve_engine/_engine.pyi

test-arm64-short:
	$(SETUP) server build arm64
	deploy/arm64_root.sh --without-training
	cmake --preset arm64 -DSPIKESERVE_BUILD_TRAIN=OFF $(if $(VERBOSE),,--log-level=WARNING)
	cmake --build build/arm64 --target $$(python3 tests/arm64/short.py --targets)
	@test -e build/release/build.ninja || cmake --preset release --log-level=WARNING
	cmake --build build/release --target spikeserve
	python3 tests/arm64/short.py

# Runs three policies on an emulated Cortex-M0+, Cortex-M4 and RV32, as the C that `spikectl emit-c` writes, moves a session
# between a server and a chip, and follows the page. The slow tests run all policies on more processors.
test-chips: configure
	$(SETUP) microcontrollers
	cmake --build $(BUILD) --target chip_stream spikectl spikeserve spiketrain spikeserve_python_engine
	ctest --test-dir $(BUILD) --tests-regex '^test_(emitted_c|emulated|moves|page)$$' --no-tests=error --output-on-failure

# Rewrites the hashes of the shipped policies' answers in tests/golden and prints which changed.
golden: configure
	cmake --build $(BUILD) --target rewrite_golden
	$(BUILD)/tests/rewrite_golden deploy/policies tests/golden/answers.txt

# Fills dist/ with everything that a release publishes: packages, wheels, sources, notes, an SBOM and checksums.
dist: configure
	cmake --build $(BUILD) --target spikeserve spikectl spikeload spiketrain spikeserve_client spikeserve_installed_engine spikeserve_c_robot spikeserve_manuals
	deploy/release/make.sh dist $(BUILD)

# Makes a site of docs/ in build/site, with the playground if there is one.
site:
	$(SETUP) release
	NO_MKDOCS_2_WARNING=1 build/release-tools/venv/bin/mkdocs build --strict --quiet
	test ! -d build/wasm/playground || cp -r build/wasm/playground build/site

# Compiles the engine to WebAssembly and makes a page of it, on which a policy plays in the browser, in build/wasm/playground.
# NODE_PATH leads Node.js of other sources than Debian to the packages of Debian that Emscripten uses.
playground:
	$(SETUP) playground
	deploy/wasm_sources.sh
	cmake --preset wasm $(if $(VERBOSE),--log-level=STATUS)
	NODE_PATH=/usr/share/nodejs cmake --build build/wasm --target playground_page golden_play

# Writes the generated pages of docs/reference.
reference: configure
	cmake --build $(BUILD) --target spikeserve spikectl spikeload spiketrain
	/usr/bin/python3 deploy/release/reference.py $(BIN) docs/reference

# Builds everything.
build: configure
	cmake --build $(BUILD)

# Measures the engine, its sessions and the server on this machine, and prints a table: about a minute on an idle machine.
bench: configure
	cmake --build $(BUILD) --target engine_bench session_bench spikeserve spikeload
	/usr/bin/python3 loadtest/bench.py --bin=$(BIN)

# Runs each attack of tests/attacks for 10 seconds and prints a table: memory and processor time of the server, latency of
# another client. ATTACKS_FLAGS="--seconds=60 rapid_reset" selects others.
attacks: build setup
	ctest --test-dir $(BUILD) --output-on-failure --tests-regex '^python_client_install$$'
	PYTHONPATH=$$(ls -td $(BUILD)/tests/python_client-* | head -1) \
	  build/venv/bin/python -m tests.attacks --program=$(BIN)/spikeserve $(ATTACKS_FLAGS)

# Plays 512 sessions on three replicas and one Redis that are killed, stopped and cut off all the time, and compares every
# answer with an undisturbed run. Needs root. CHAOS_FLAGS="--decisions=200" makes it shorter.
chaos: build setup
	ctest --test-dir $(BUILD) --output-on-failure --tests-regex '^python_client_install$$'
	SPIKESERVE_PROGRAM=$(BIN)/spikeserve PYTHONPATH=$$(ls -td $(BUILD)/tests/python_client-* | head -1) \
	  build/venv/bin/python -m tests.chaos $(CHAOS_FLAGS)

# Shows one decision, from an agent in Python through nginx to Redis, as a collector of traces receives it; a few seconds.
trace: build setup
	ctest --test-dir $(BUILD) --output-on-failure --tests-regex '^python_client_install$$'
	SPIKESERVE_PROGRAM=$(BIN)/spikeserve SPIKESERVE_INTEROP=build/interop PYTHONPATH=$$(ls -td $(BUILD)/tests/python_client-* | head -1) \
	  build/venv/bin/python -m tests.tracing

# Does all kinds of work for hours and prints what the server holds after each minute of it. Fails if memory grows by more
# than 1 MB a million decisions, or descriptors or threads grow. SOAK_SECONDS=1800 makes it shorter.
SOAK_SECONDS := 14400
soak: build setup
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
fuzz:
	$(SETUP) server build clang
	tests/fuzz/run.sh $(FUZZ_SECONDS)

# Rewrites the format of the C++ code.
format:
	$(SETUP) clang
	clang-format -i $(SOURCES)

# Lists the targets.
help:
	@awk '/^# / { text = text substr($$0, 2) } /^[a-z][a-z0-9-]*:/ && !/:=/ && text { sub(/:.*/, ""); \
	  sub(/\. .*/, ".", text); if (!seen[$$0]++) printf "%-16s%s\n", $$0, text } !/^# |^[A-Z_]+ / { text = "" }' $(firstword $(MAKEFILE_LIST))

# Removes what was built.
clean:
	rm -rf build

# Everything that `make test` needs.
setup:
	$(SETUP)

configure:
	$(SETUP) server build
	cmake --preset release $(if $(VERBOSE),,--log-level=WARNING)

-include lab/lab.mk
