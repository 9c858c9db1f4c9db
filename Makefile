# `make demo` and `make test` set up everything they need in .venv; nothing else has to be installed first.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
APT := apt-get install --yes --no-install-recommends
PIP := $(BIN)/pip install --quiet --disable-pip-version-check --constraint constraints.txt

.DEFAULT_GOAL := help
.PHONY: help demo svea-demo test test-nats test-ros1 test-train test-sumo agents interoperability test-all test-matrix test-browser docs site-version notebooks names lint format bench stages cuda-check gpu schema pages clean

help: ## this list
	@grep -hE '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/' | expand -t 12

$(BIN)/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
		{ echo "coopenv needs Python 3.11 or newer; name one with: make demo PYTHON=/path/to/python3"; exit 1; }
	@$(PYTHON) -m venv $(VENV)

$(VENV)/.base: $(BIN)/python pyproject.toml constraints.txt
	@echo "Installing coopenv into $(VENV) (once) ..."
	@$(PIP) --editable .
	@touch $@

$(VENV)/.view: $(VENV)/.base
	@echo "Installing what draws in the browser into $(VENV) (once) ..."
	@$(PIP) --editable '.[view]'
	@touch $@

$(VENV)/.dev: $(VENV)/.base
	@echo "Installing the development tools into $(VENV) (once) ..."
	@$(PIP) --editable '.[dev]'
	@touch $@

demo: $(VENV)/.view ## run the paper's busy intersection; table here, figures and replay.html in out/busy_intersection
	@$(BIN)/coopenv run busy_intersection --seed 0 --out out/busy_intersection --open

$(VENV)/.svea: $(VENV)/.base
	@echo "Installing what cars need into $(VENV) (once) ..."
	@$(PIP) --editable '.[svea]'
	@touch $@

svea-demo: $(VENV)/.svea ## two fake cars overtake; table here, figures in out/svea_overtaking, half a minute
	@$(BIN)/coopenv svea demo --out out/svea_overtaking

# Three workers on two cores: tests of cars wait for their clock most of the time.
test: lint ## lint, type check and all tests but the slow ones
	@$(BIN)/python -m pytest -n 3 --dist loadfile -m "not slow and not nats and not ros1 and not browser"

test-nats: $(VENV)/.dev ## the tests that need a NATS broker (installs Debian's nats-server, as root)
	@PATH="$$PATH:/usr/sbin"; command -v nats-server > /dev/null || $(APT) nats-server
	@$(BIN)/python -m pytest -m nats tests/cars/link

# ROS 1 is of the system's interpreter, which sees what Debian has installed.
.venv-ros1/.dev: pyproject.toml constraints.txt
	@/usr/bin/python3 -c 'import rospy, rosmaster, geometry_msgs' 2> /dev/null || \
		$(APT) python3-venv python3-rospy python3-rosmaster python3-geometry-msgs
	@/usr/bin/python3 -m venv --system-site-packages .venv-ros1
	@.venv-ros1/bin/pip install --quiet --disable-pip-version-check --constraint constraints.txt \
		--editable '.[svea]' hypothesis pytest
	@touch $@

test-ros1: .venv-ros1/.dev ## the tests that need a ROS 1 master (installs Debian's rospy, as root)
	@.venv-ros1/bin/python -m pytest -m ros1 tests/cars/link

$(VENV)/.train: $(VENV)/.dev
	@echo "Installing torch and Stable-Baselines3 into $(VENV) (once) ..."
	@$(PIP) --editable '.[train,onnx]'
	@touch $@

test-train: $(VENV)/.train ## the tests that train policies (installs torch)
	@$(BIN)/python -m pytest -m train

agents: $(VENV)/.train ## train the agents of agents/ that learn, about two hours; goes on where it was interrupted
	@$(BIN)/python -m benchmarks.learning agents/study.toml

$(VENV)/.study: $(VENV)/.train
	@echo "Installing the methods of the study into $(VENV) (once) ..."
	@$(PIP) --editable '.[study]'
	@touch $@

study: $(VENV)/.study ## compare methods of learning, about an hour; goes on where it was interrupted
	@OMP_NUM_THREADS=1 $(BIN)/python -m benchmarks.methods --page docs/environments/methods.md

test-sumo: $(VENV)/.dev ## the tests that need SUMO (250 MB)
	@$(PIP) --editable '.[sumo]'
	@$(BIN)/python -m pytest -k sumo tests/sumo tests/sources tests/test_envs.py

interoperability: $(VENV)/.base ## first examples of other projects with coopenv, each in its own environment (4 GB); writes docs/interoperability.md
	@$(BIN)/python -m benchmarks.interoperability --page docs/interoperability.md

test-all: lint ## every test whose tools are installed
	@$(BIN)/python -m pytest -n 2 --dist loadfile

$(VENV)/.uv: $(VENV)/.dev
	@$(PIP) uv
	@touch $@

test-matrix: $(VENV)/.uv ## the tests under other Pythons, versions and processors; CELLS="lowest newest" for some of them
	@$(BIN)/python .ci/matrix.py $(CELLS)

$(VENV)/.docs: $(VENV)/.dev
	@echo "Installing what the documentation site needs into $(VENV) (once) ..."
	@$(PIP) --editable '.[docs]'
	@touch $@

docs: $(VENV)/.docs ## build the documentation site, out/site/index.html; links are checked
	@NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet
	@echo "The site: out/site/index.html"

site-version: $(VENV)/.docs ## put the site of VERSION (such as 0.9) beside those of earlier versions, on the local branch gh-pages
	@SITE_VERSIONS=mike NO_MKDOCS_2_WARNING=1 $(BIN)/mike deploy --update-aliases --alias-type redirect $(VERSION) latest
	@$(BIN)/mike set-default latest

notebooks: $(VENV)/.docs ## write the tutorials as notebooks to examples/notebooks
	@$(BIN)/python -m sitegen.notebooks

names: $(VENV)/.dev ## write the public names with their signatures to tests/public_names.txt
	@$(BIN)/python -m sitegen.public_names

test-browser: $(VENV)/.docs $(VENV)/.view ## the tests that open pages in headless Chromium (installs Debian's chromium, as root)
	@command -v chromium > /dev/null || $(APT) chromium fonts-dejavu-core
	@$(BIN)/python -m pytest -m browser

lint: $(VENV)/.dev ## ruff and mypy
	@$(BIN)/ruff check .
	@$(BIN)/ruff format --check .
	@$(BIN)/mypy

format: $(VENV)/.dev ## let ruff rewrite what it can
	@$(BIN)/ruff check --fix .
	@$(BIN)/ruff format .

bench: $(VENV)/.base ## measure steps per second
	@$(BIN)/python -m benchmarks.speed

stages: $(VENV)/.base ## measure what a vehicle tick costs, stage by stage
	@$(BIN)/python -m benchmarks.stages

$(VENV)/.cuda: $(VENV)/.dev
	@$(PIP) --no-deps nvidia-cuda-nvcc
	@touch $@

cuda-check: $(VENV)/.cuda ## compile all kernels for three GPUs without one, and hold their limits; CUDA_OPTIONS=...
	@$(BIN)/python -m benchmarks.cuda_check $(CUDA_OPTIONS)

gpu: ## on a machine with a GPU: CUDA tests, CPU against CUDA, throughput, a training; DEVICE=cuda:1, WHEELS=DIR
	@$(PYTHON) -m benchmarks.gpu.prepare .venv-gpu $(if $(WHEELS),--wheels $(WHEELS))
	@.venv-gpu/bin/python -m benchmarks.gpu --device $(or $(DEVICE),cuda:0) $(GPU_OPTIONS)

schema: $(VENV)/.base ## write the JSON schema of scenario files, which editors complete from
	@$(BIN)/coopenv schema --out docs/scenario.schema.json

pages: $(VENV)/.base ## write the pages of the environments and the replay of the home page; MEASURE=--measure for their figures, too
	@$(BIN)/python -m sitegen.environments --all $(MEASURE) --out docs/environments
	@$(BIN)/python -m sitegen.replay

clean: ## remove the virtual environment and all results
	@rm -rf $(VENV) .venv-gpu .venv-ros1 out build dist *.egg-info .pytest_cache .ruff_cache .mypy_cache .hypothesis
