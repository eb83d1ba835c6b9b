# The doors of the project. Every target works in .venv, built from pyproject.toml and constraints.txt: `make setup` installs all
# packages, a target that only searches, shows or tests installs those that this takes.
.DEFAULT_GOAL := help
.PHONY: help setup archive train finetune harden evaluate report view bench docs pictures release-check test test-all test-gpu lint

PYTHON ?= python3
ROBOT ?=
ARGS ?=
TORCH ?=
BIN := .venv/bin
EXTRAS := [cluster,dev,menagerie,onnx,train]
TEST_EXTRAS := [onnx,test,train]
SEARCH := .venv/.search-done
TEST := .venv/.test-done
STAMP := .venv/.setup-done
# The torch that was asked for is kept: a later setup does not put the pinned one back.
ifneq ($(TORCH),)
ANEW := anew
else
TORCH := $(shell cat .venv/torch 2>/dev/null)
endif
PYTEST := $(BIN)/python -m pytest
ON_TWO_CORES := -n 2 --dist loadfile
FAULTLINE_DEVICE ?= cuda:0

quoted = '$(subst ','\'',$(1))'

# A variable that make was given and nobody reads is a misspelt one.
KNOWN := ROBOT ARGS PYTHON TORCH FAULTLINE_DEVICE
UNKNOWN := $(foreach name,$(filter-out $(KNOWN),$(.VARIABLES)),$(if $(filter command,$(origin $(name))),$(name)))
NEAREST = import difflib, sys; print("".join(difflib.get_close_matches(sys.argv[1].upper(), sys.argv[2:], 1)))
ifneq ($(strip $(UNKNOWN)),)
near := $(shell $(PYTHON) -c '$(NEAREST)' $(call quoted,$(firstword $(UNKNOWN))) $(KNOWN))
$(error unknown variable $(strip $(UNKNOWN))$(if $(near),; did you mean $(near)?): expected $(KNOWN). \
Flags of a command go through ARGS, for example make archive ARGS="--policy FILE --seed 3")
endif

faultline = $(BIN)/faultline $(1) $(if $(ROBOT),--robot $(call quoted,$(ROBOT))) $(ARGS)

help: ## This list
	@echo 'faultline finds the terrains that break a legged robot. Targets:'
	@awk -F ':.*## ' '/^[a-z-]+:.*## / { printf "  make %-9s %s\n", $$1, $$2 }' $(MAKEFILE_LIST)
	@echo 'Variables:'
	@echo '  ROBOT=anymal   anymal, cassie, or the settings file of a robot of your own, such as mine/dog.py'
	@echo '  ARGS="..."     flags for the command: make archive ROBOT=anymal ARGS="--preset small --seed 3"'
	@echo '  PYTHON=python3 the interpreter that .venv is made from, 3.11 or newer'
	@echo '  TORCH=...      torch other than the pinned one: a requirement or a wheel, for example for your GPU driver'
	@echo 'All commands: $(BIN)/faultline --help. All flags of one: $(BIN)/faultline archive --help. Pages: docs/.'

setup: $(STAMP) ## Make .venv with the pinned packages, unless it is up to date

.PHONY: anew
# $(1): extras in brackets. Python compiles a module when it is first imported; pip would compile all of them, most for nobody.
define install
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { \
	  echo "make setup: PYTHON=$(PYTHON) must be Python 3.11 or newer, got: $$($(PYTHON) --version 2>&1)." >&2; \
	  echo 'Name another one: make setup PYTHON=python3.12' >&2; exit 1; }
	@echo 'Installing the pinned packages$(if $(1), with extras $(1)) into .venv. The first time takes some minutes.'
	test -x $(BIN)/python || $(PYTHON) -m venv .venv
	grep -v $(if $(TORCH),'^torch==','^$$') constraints.txt > .venv/constraints.txt
	$(if $(TORCH),$(BIN)/python -m pip install $(call quoted,$(TORCH)) && echo $(call quoted,$(TORCH)) > .venv/torch)
	$(BIN)/python -m pip install --no-compile -e '.$(1)' -c .venv/constraints.txt
endef

$(SEARCH): pyproject.toml constraints.txt $(ANEW)
	$(call install)
	@touch $@

$(TEST): pyproject.toml constraints.txt $(ANEW)
	$(call install,$(TEST_EXTRAS))
	@touch $(SEARCH) $@

$(STAMP): pyproject.toml constraints.txt $(ANEW)
	$(call install,$(EXTRAS))
	@touch $(SEARCH) $(TEST) $@

archive: $(SEARCH) ## Search the terrains on which a controller fails; writes a run under runs/
	$(call faultline,archive)

train: setup ## Train a base controller from scratch
	$(call faultline,train)

finetune: setup ## Train a controller further on terrains that broke it
	$(call faultline,finetune)

harden: setup ## Rounds of search and training, until a search finds little that breaks the controller
	$(call faultline,harden)

evaluate: $(SEARCH) ## Measure rates of one controller, or make the tables of several
	$(call faultline,evaluate)

report: $(SEARCH) ## Write one HTML page about a run
	$(call faultline,report)

view: $(SEARCH) ## Show an archive in the browser
	$(call faultline,view)

bench: setup ## Time every kernel against torch and against the device's ceiling
	$(BIN)/python -m tests.bench $(if $(ROBOT),--robot $(call quoted,$(ROBOT))) $(ARGS)

docs: setup ## Write the tables of README and docs/ anew from the results
	$(BIN)/python -m results.make.docs

pictures: setup ## Make the pictures of README and docs/ anew: some minutes, a browser
	$(BIN)/python -m results.make.pictures

release-check: setup ## Name the files below results/ that this checkout's sources did not make
	$(BIN)/python -m results.make.common

test: $(TEST) ## Run the quick tests: some minutes on two cores
	$(PYTEST) $(ON_TWO_CORES) -m 'not slow and not ray' $(ARGS)

test-all: setup ## Run all tests: about seven minutes on two cores
	$(PYTEST) $(ON_TWO_CORES) $(ARGS)

test-gpu: setup ## Run on a GPU (FAULTLINE_DEVICE, default cuda:0) what can run there
	FAULTLINE_DEVICE=$(FAULTLINE_DEVICE) $(PYTEST) -m gpu $(or $(ARGS),--record=results/bench/gpu-tests.json)

lint: setup ## Check style, documentation and types
	$(BIN)/ruff check .
	$(BIN)/pyright
