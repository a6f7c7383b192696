# Targets of the laboratory, which the Makefile includes if the folder is there. They build in the folder of the product.
LAB := build/release
LAB_PYTHON = PYTHONPATH=$$(ls -td $(LAB)/tests/python_client-* | head -1):$(LAB)/python:lab/recipes build/venv/bin/python
LAB_CLIENT = ctest --test-dir $(LAB) --output-on-failure --tests-regex '^python_client_install$$'

.PHONY: lab lab-test lab-study lab-train lab-bench lab-beats lab-parts lab-chips lab-ope lab-frontier

lab:
	$(SETUP) server build
	cmake --preset lab $(if $(VERBOSE),,--log-level=WARNING)
	cmake --build $(LAB) --target lab

# A miniature of the study, of the report and of the recipes, and the checks of their pages: a few minutes.
lab-test: lab
	cmake --build $(LAB) --target lab_report_test
	ctest --preset lab

# Trains what lab/evidence/study.md compares, for hours, and writes its tables. Continues a study that was interrupted.
# STUDY_FLAGS="--seeds=3 --jobs=2" selects less, and runs two at the same time.
lab-study: lab
	$(LAB_CLIENT)
	$(LAB_PYTHON) lab/study/study.py --work=build/study --out=lab/study/runs --spiketrain=$(LAB)/bin/spiketrain $(STUDY_FLAGS)
	$(LAB_PYTHON) lab/study/study_page.py lab/study/runs lab/evidence/study.md
	$(LAB_PYTHON) lab/study/study_curves.py lab/study/runs lab/evidence/settings.png

# Trains the CartPole policy of the paper's size in build/train. Continues a run that was interrupted.
lab-train: lab
	lab/recipes/cartpole.sh $(LAB)/bin/spiketrain build/train

# Runs all contestants, which takes about eighteen minutes on an idle machine, and writes lab/evidence/performance.md.
# BENCH_FLAGS="--rounds=20" makes the runs longer, "--sections engine" selects a part; the page is then build/release/bench.md.
lab-bench: lab
	$(SETUP) tests full chips interop
	lab/bench/setup.sh $(LAB)/bench_venv
	$(LAB)/bench_venv/bin/python lab/bench/bench.py --bin=$(LAB)/bin --python=$(LAB)/bench_venv/bin/python \
	  --json=$(LAB)/bench.json --markdown=$(if $(BENCH_FLAGS),$(LAB)/bench.md,lab/evidence/performance.md) $(BENCH_FLAGS)

# Counts the beats of robots without a fresh action over links with delay, loss and cuts: the rows that lab/bench/beats.json
# has not. BEATS_FLAGS='--rows="link cut"' runs those that match instead, --rows=. all of them, in about 20 minutes. Needs root.
lab-beats: lab
	build/venv/bin/python lab/bench/beats_bench.py --bin=$(LAB)/bin --pages $(BEATS_FLAGS)

# Measures parts that `make lab-bench` does not: calls by thread, memory of connections, a neighbour during floods, traces that
# nobody samples, the engine in Python, and online learning on the reversed CartPole. ADAPT_FLAGS selects another row of
# lab/evidence/online-learning.md. A few minutes.
ADAPT_FLAGS ?= --env=CartPole-v1 --perturb=force=-1 --episodes=60
lab-parts: lab
	$(LAB_CLIENT)
	$(LAB_PYTHON) lab/bench/call_costs.py --server=$(LAB)/bin/spikeserve
	build/venv/bin/python lab/bench/connection_memory.py --server=$(LAB)/bin/spikeserve
	build/venv/bin/python lab/bench/flood_bench.py --bin=$(LAB)/bin
	build/venv/bin/python lab/bench/trace_costs.py --server=$(LAB)/bin/spikeserve
	$(LAB_PYTHON) lab/bench/binding_bench.py --bin=$(LAB)/bin
	python3 lab/bench/adapt_sweep.py --bin=$(LAB)/bin $(ADAPT_FLAGS)

# Measures what policies, dense baselines and perceptrons cost on emulated microcontrollers: docs/evidence/microcontrollers.md.
lab-chips: lab
	$(SETUP) microcontrollers
	cmake --build $(LAB) --target chip_stream
	SPIKECTL_PROGRAM=$(LAB)/bin/spikectl CHIP_STREAM_PROGRAM=$(LAB)/tests/chip_stream DENSE_BASELINE_PROGRAM=$(LAB)/bin/dense_baseline \
	  build/venv/bin/python lab/microcontrollers/costs.py

# Compares the intervals of `spiketrain ope` with known returns, about ten minutes a task on an idle core. Continues lab/evidence/ope.csv and
# prints the table of lab/evidence/off-policy.md.
lab-ope:
	$(SETUP) build
	cmake --preset lab $(if $(VERBOSE),,--log-level=WARNING)
	cmake --build $(LAB) --target ope_coverage
	$(LAB)/bin/ope_coverage --out=lab/evidence/ope.csv

# Trains spiking policies and event-driven rivals on a task with sparse observations: lab/evidence/frontier.md. Continues a run that
# was interrupted. FRONTIER_FLAGS="--seeds=10 --widths=16,32,64 --iterations=10000" compares more, for longer.
lab-frontier: lab
	$(LAB_CLIENT)
	$(LAB_PYTHON) lab/frontier/frontier.py --work=build/frontier --out=build/frontier/runs.csv --spiketrain=$(LAB)/bin/spiketrain \
	  $(FRONTIER_FLAGS)
