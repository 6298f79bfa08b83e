# One-command entry points. Everything runs in .venv, which is made on first use and remade when the pins change.
# The same steps as plain commands, for Windows too, are in the README.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed

.DEFAULT_GOAL := help
.PHONY: help install demo test lint format lab labs book proof-book proof-notebooks proof-browser proof-hub bundle train bench profiles proof-drive proof-devices proof-bottlenecks proof-reach proof-velocity proof-gap conformance-ros conformance-isaaclab conformance-tensorrt proof-optimisation mutation-test attacks proof-grading clean

help:  ## Show this list
	@grep -E '^[a-z-]+:.*##' $(MAKEFILE_LIST) | awk -F ':.*## ' '{printf "  make %-15s %s\n", $$1, $$2}'

$(STAMP): pyproject.toml constraints.txt
	$(PYTHON) -c "import sys; sys.exit(sys.version_info < (3, 11) and 'robotbrain needs Python 3.11 or newer; set PYTHON=...')"
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable ".[dev]"
	@touch $(STAMP)

install: $(STAMP)  ## Make .venv and install the kit into it

demo: $(STAMP)  ## The main job: make the labs, grade the sample class, drive the robot, show one page
	$(BIN)/robotbrain demo

test: $(STAMP)  ## Run the tests, two files at a time
	$(BIN)/python -m pytest --numprocesses 2 --dist loadfile

lint: $(STAMP)  ## Check style and types
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/robotbrain notebooks check course labs solutions

format: $(STAMP)  ## Put code and notebooks into canonical form
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .
	$(BIN)/robotbrain notebooks fix course labs solutions

lab: $(STAMP)  ## Open JupyterLab on the course
	$(BIN)/robotbrain lab

book: $(STAMP)  ## Make a static site of the course, outputs included (five minutes the first time)
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable ".[book]"
	$(BIN)/python book/build.py

proof-book: book  ## Let a browser read every page of the book: links, accessibility, search, replays, times (half an hour)
	ROBOTBRAIN_NO_SKIP=1 ROBOTBRAIN_BOOK=$(CURDIR)/book/_build/html $(BIN)/python -m pytest tests/test_book.py
	$(BIN)/python benchmarks/book.py

labs: $(STAMP)  ## Generate labs/ from solutions/
	$(BIN)/robotbrain generate

train: $(STAMP)  ## Train the perception network again (a few minutes) and report its figure
	$(BIN)/robotbrain train segmentation

proof-drive: $(STAMP)  ## Drive 100 unseen worlds (about ten minutes)
	$(BIN)/python benchmarks/drive_success.py

proof-devices: $(STAMP)  ## Drive the same 20 worlds on five Jetsons (about twenty minutes)
	$(BIN)/python benchmarks/devices.py

proof-bottlenecks: $(STAMP)  ## Find planted bottlenecks in generated pipelines, and check what the cure was said to bring
	$(BIN)/python benchmarks/bottlenecks.py

proof-reach: $(STAMP)  ## Learn to reach, five seeds, against Stable-Baselines3 (hours; goes on where it was stopped)
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable ".[peers]"
	$(BIN)/python benchmarks/rl_reach.py
	$(BIN)/python benchmarks/rl_gymnasium.py

proof-velocity: $(STAMP)  ## Let the shipped walking policy follow 200 unseen commands, with and without pushes
	$(BIN)/python benchmarks/rl_velocity.py

proof-gap: $(STAMP)  ## Train with and without randomisation and compare on surrogate arms (about half an hour)
	$(BIN)/python benchmarks/rl_sim_to_real.py

conformance-ros: $(STAMP)  ## Compare the kit with genuine ROS 2 (Linux x86-64; downloads about 1.7 GB once)
	$(BIN)/python -m tests.conformance_ros
	$(BIN)/python -m tests.conformance_ros.drive
	PYTHONPATH=$(CURDIR)/src ROBOTBRAIN_GENUINE_PYTHON=$(CURDIR)/build/conformance/kilted-drive/bin/python $(BIN)/python -m pytest tests/link/test_genuine.py

conformance-isaaclab: $(STAMP)  ## Compare the tasks' terms with genuine Isaac Lab 3.0 (downloads its wheel once)
	$(BIN)/python -m tests.conformance_isaaclab

conformance-tensorrt: $(STAMP)  ## Compare the names the engine uses with the genuine TensorRT bindings (Linux, gcc; downloads 6 MB)
	$(BIN)/python -m tests.conformance_tensorrt

proof-optimisation: $(STAMP)  ## Students against the teacher over three seeds, QAT, sparsity, the Pareto sweep (about an hour)
	$(BIN)/python benchmarks/opt_student.py --run-dir build/opt_student
	$(BIN)/python benchmarks/opt_qat.py
	$(BIN)/python benchmarks/opt_sparsity.py
	$(BIN)/python benchmarks/opt_imagenet.py
	$(BIN)/python benchmarks/opt_precisions.py
	$(BIN)/python benchmarks/opt_sweep.py

profiles: $(STAMP)  ## Calibrate the Jetson twin and write the reference profiles again
	$(BIN)/robotbrain jetson calibrate
	$(BIN)/robotbrain jetson reference

mutation-test: $(STAMP)  ## Test the tests of the labs with named wrong solutions
	$(BIN)/robotbrain mutation-test --all --jobs 2

proof-notebooks: $(STAMP)  ## Run every notebook from a clean kernel beside the time that it states (a quarter of an hour; resumes)
	$(BIN)/python benchmarks/notebooks.py --write

proof-browser: $(STAMP)  ## The whole course in a browser: every lesson, and every lab from stub to feedback (an hour)
	ROBOTBRAIN_PROOF=browser $(BIN)/python -m pytest tests/browser/test_jupyterlab.py tests/browser/test_walk.py

proof-hub: $(STAMP)  ## A class on a genuine JupyterHub with three accounts (Linux, root, node; about two minutes)
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable ".[hub]"
	$(BIN)/python -m tests.hub

bundle: $(STAMP)  ## The course as a zip for students, without the key
	$(BIN)/robotbrain bundle

attacks: $(STAMP)  ## Try every attack on the grader, in all its variants (ten minutes)
	ROBOTBRAIN_ATTACKS=all $(BIN)/python -m pytest tests/grading/attacks

proof-grading: $(STAMP)  ## The grader against stock nbgrader, and a thousand submissions with kills (an hour)
	$(BIN)/python benchmarks/grading_stock.py
	$(BIN)/python benchmarks/grading_thousand.py

bench: $(STAMP)  ## Run the benchmarks; each prints one table
	$(BIN)/python benchmarks/ros_rate.py
	$(BIN)/python benchmarks/sim_rate.py
	$(BIN)/python benchmarks/twin_accuracy.py
	$(BIN)/python benchmarks/cpu_work.py
	$(BIN)/python benchmarks/patterns.py
	$(BIN)/python benchmarks/jitter.py
	$(BIN)/python benchmarks/monitoring_overhead.py
	$(BIN)/python benchmarks/rl_stepping.py
	$(BIN)/python benchmarks/checks.py

clean:  ## Remove .venv, caches and generated pages
	rm -rf $(VENV) .pytest_cache .mypy_cache .ruff_cache demo build dist book/_build
