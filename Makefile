# Everything runs in .venv, made on first use from Python 3.11 or newer.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin

.PHONY: demo test lint types bench fuzz soak remote-link recordings deb board-test clean venv

# Of the packages: make deb SUITES=bookworm ARCHITECTURES=armhf
SUITES ?= bookworm trixie
ARCHITECTURES ?= amd64 arm64 armhf
.DEFAULT_GOAL := help

help:
	@echo "make demo    simulated robot + daemon + report, about three minutes"
	@echo "make test    lint, types and tests, under eight minutes"
	@echo "make bench   accuracy and speed tables (long)"
	@echo "make soak    a device unplugged and replugged 200 times, two minutes"
	@echo "make remote-link  robot and operator over 64 kbit/s with outages, as root, half an hour"
	@echo "make fuzz    ten million bytes of noise and damage for each decoder"
	@echo "make recordings   the five scenarios as recordings, some minutes"
	@echo "make deb     Debian packages in dist/, a minute each"
	@echo "make board-test   the package on an emulated board, as root, a quarter of an hour"

$(VENV)/.sim: pyproject.toml
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --upgrade pip
	$(BIN)/python -m pip install --quiet -e '.[sim,operator]'
	touch $@

$(VENV)/.dev: $(VENV)/.sim
	$(BIN)/python -m pip install --quiet -e '.[sim,operator,dev]'
	touch $@

venv: $(VENV)/.dev

demo: $(VENV)/.sim
	$(BIN)/robominer-slam demo --out out

lint: $(VENV)/.dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: $(VENV)/.dev
	$(BIN)/mypy

test: lint types
	OPENBLAS_NUM_THREADS=1 $(BIN)/python -m pytest -n 2

bench: $(VENV)/.dev
	$(BIN)/python benchmarks/pose_graph.py
	$(BIN)/python -m benchmarks.thesis_table --jobs 2 --report out/thesis-table.html

soak: $(VENV)/.dev
	$(BIN)/python -m benchmarks.soak_hotplug

remote-link: $(VENV)/.dev
	$(BIN)/python -m benchmarks.remote_link --outages 50

fuzz: $(VENV)/.dev
	$(BIN)/python -m benchmarks.fuzz_decoders

recordings: $(VENV)/.sim
	$(BIN)/python -m benchmarks.make_recordings

deb: $(VENV)/.sim
	for suite in $(SUITES); do for architecture in $(ARCHITECTURES); do \
	  packaging/build_deb.sh $(BIN)/python $$architecture $$suite dist || exit; done; done

board-test: $(VENV)/.sim
	test -e dist/robominer-slam_*+deb12_armhf.deb -a -e dist/robominer-slam_*+deb12_amd64.deb || \
	  $(MAKE) deb SUITES=bookworm ARCHITECTURES="amd64 armhf"
	benchmarks/board/board_test.sh $(BIN)/python $(STEPS)

clean:
	rm -rf $(VENV) out build dist .mypy_cache .ruff_cache .pytest_cache
