# `make demo` and `make test` do their whole set-up in .venv; a second run starts at once.
.PHONY: help packages setup demo test test-all test-release other-pythons soak lint check bench zoo clean
.DEFAULT_GOAL := help
# A process a core; tests of one file stay together, since they share what is slow to make.
PARALLEL := -n auto --dist loadfile

help:
	@echo "make demo    build a furnished room, label it and show it: pictures and scores in out/demo"
	@echo "make test    run the fast tests; make test-all the slow ones too, as CI does"
	@echo "make test-release  small faults, one by one: does a test turn red? ten times the fuzzing (some twenty minutes)"
	@echo "make soak    ten minutes of frames, as a robot's: is memory flat?"
	@echo "make lint    ruff and pyright"
	@echo "make check   stiff and extreme cases beside references: table, CSV and picture in out/check"
	@echo "make bench   seconds and error of the main pieces of work, beside another revision (AGAINST=REV)"
	@echo "make zoo     fit many small scenes of many kinds beside baselines: table, CSV and picture in out/zoo"
	@echo "make setup   only make .venv, with the libraries that Open3D and PyVista need"
	@echo "make clean   remove .venv, out and the caches"

packages:
	@PYTHON="$(PYTHON)" scripts/setup.sh packages

setup: packages
	@PYTHON="$(PYTHON)" scripts/setup.sh

demo: setup
	@.venv/bin/og-pointcloud demo -o out/demo

test: setup
	@.venv/bin/python -m pytest $(PARALLEL) -m "not slow"

test-all: setup
	@.venv/bin/python -m pytest $(PARALLEL) -m "not release"

test-release: setup
	@.venv/bin/python -m pytest $(PARALLEL) -m release

other-pythons:
	@scripts/other_pythons.sh

soak: setup
	@OG_POINTCLOUD_SOAK_S=600 .venv/bin/python -m pytest -s -q tests/test_trust.py -k test_soak

lint: packages
	@.venv/bin/ruff check
	@.venv/bin/ruff format --check
	@.venv/bin/pyright --threads 2 --pythonpath .venv/bin/python

check: setup
	@.venv/bin/python tests/hard_cases -o out/check

bench: setup
	@.venv/bin/python examples/bench.py $(if $(AGAINST),--against $(AGAINST))

zoo: setup
	@.venv/bin/python examples/zoo.py -o out/zoo

clean:
	rm -rf .venv out .pytest_cache .ruff_cache
	find og_pointcloud export plugins examples tests -name __pycache__ -prune -exec rm -rf {} +
