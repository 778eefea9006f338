# `make` lists the targets. Each sets up what it needs by itself (tools/setup.sh).
#   PYTHON=python3.12   the Python that makes the environment (3.10 to 3.13)
#   VENV=.venv          where the environment goes
#   ARGS="-k codec"     handed on to the command behind demo, test, bench, train-mini and libero

SHELL := bash
.DEFAULT_GOAL := help
.PHONY: help demo test lint bench image-check proto train-mini libero

PYTHON ?= python3
VENV ?= .venv
ARGS ?=
export PYTHON VENV

BIN := $(VENV)/bin

help: ## list these targets
	@awk -F ':.*## ' '/^[a-z-]+:.*## / {printf "  make %-11s %s\n", $$1, $$2}' $(MAKEFILE_LIST)

demo: ## four episodes over a simulated radio link, and a film of them: runs/demo/demo.html
	@tools/setup.sh sim
	$(BIN)/comvla-sim demo $(ARGS)

# Tests of deadlines run first and by themselves, everything else in parallel. One thread per process:
# two workers that each start a thread per core only wait for one another. Coverage is of the whole
# suite, so ARGS that choose some tests leave it out, and a choice may leave one of the two runs empty.
test: export OMP_NUM_THREADS := 1
test: ## all tests, with real servers and the real simulator; coverage at least 90 %
	@tools/setup.sh dev
	@tools/setup.sh proto
	$(BIN)/python -m pytest -m alone $(ARGS) || [ $$? = 5 ]
	$(BIN)/python -m pytest -m "not alone" -n 2 $(if $(ARGS),,--cov --cov-report=term:skip-covered) $(ARGS) || [ $$? = 5 ]

lint: ## style, types, import rules, protocol rules
	@tools/setup.sh dev
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/mypy
	$(BIN)/lint-imports
	$(BIN)/buf lint proto

bench: ## transport, edge, batching and model, each against a limit measured in the same run
	@tools/setup.sh sim
	$(BIN)/comvla-sim bench transport $(ARGS)
	$(BIN)/comvla-sim bench edge $(ARGS)
	$(BIN)/comvla-sim bench batching $(ARGS)
	$(BIN)/comvla-sim bench model $(ARGS)

image-check: ## build what the Dockerfiles build without a container engine, and call it (root)
	@tools/setup.sh dev
	@tools/setup.sh image
	$(BIN)/python docker/image_check.py $(ARGS)

proto: ## regenerate the code of proto/comvla/v1/policy.proto
	@tools/proto.sh

train-mini: ## train the shipped policy from scratch (hours); resumes where it stopped
	@tools/setup.sh sim
	$(BIN)/comvla-sim train $(ARGS)

libero: ## LIBERO's own environment: ARGS=--download for its assets, or COMVLA_LIBERO_ASSETS=FOLDER
	@tools/setup.sh sim
	$(BIN)/comvla-sim libero setup $(ARGS)
