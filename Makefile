# Every target runs in .venv, which `make setup` builds from pyproject.toml and constraints.txt.
.DEFAULT_GOAL := help
.PHONY: help setup stand archive compare ablation train finetune calibrate replay report view reevaluate evaluate video export tables crosscheck bench test lint clean

PYTHON ?= python3
ROBOT ?= anymal
BIN := .venv/bin
STAMP := .venv/.setup-done

# The flags of the variables that are set, of those named: $(call flags,DEVICE SEED) -> --device='cpu'
flags = $(foreach name,$(1),$(if $($(name)),--$(FLAG_$(name))=$(call quoted,$($(name)))))
quoted = '$(subst ','\'',$(1))'
FLAG_PRESET := preset
FLAG_DEVICE := device
FLAG_ITERATIONS := iterations
FLAG_POLICY := policy
FLAG_SEED := seed
FLAG_RESUME := resume
FLAG_RUN := run
FLAG_MIX := mix
FLAG_DRAW := draw
FLAG_REWARDS := rewards
FLAG_TASK := task
FLAG_EXPORT := export
FLAG_ELITE := elite
FLAG_OUT := out
FLAG_GENES := genes
FLAG_WORKERS := workers
FLAG_WORKER_LIMIT_S := worker-limit-s
FLAG_PROCESSES := processes
FLAG_REPRODUCE := reproduce
FLAG_FINE := fine
FLAG_METHOD := method
FLAG_INTERVALS := intervals
FLAG_WITHOUT := without
FLAG_POLICIES := policies
FLAG_ARCHIVE := archive
FLAG_SPLIT_SEED := split-seed
FLAG_SETS := sets
FLAG_TERRAINS := terrains
FLAG_TERRAIN := terrain
FLAG_SIZE := size
FLAG_SCALE := scale
FLAG_OFFSET := offset
FLAG_RECORDING := recording
FLAG_FORMATS := formats
FLAG_EPISODES := episodes
FLAG_TABLES := tables
FLAG_PORT := port
FLAG_HOST := host

help: ## This list
	@echo 'faultline: find the terrains that break a legged robot. Targets:'
	@awk -F ':.*## ' '/^[a-z]+:.*## / { printf "  make %-10s %s\n", $$1, $$2 }' $(MAKEFILE_LIST)
	@echo
	@echo 'Variables (left out: the default of the command):'
	@echo '  ROBOT=anymal     which robot: anymal, cassie, or the settings file of one of your own, such as mine/dog.py'
	@echo '  DEVICE=cpu       cpu, cuda or cuda:N               stand archive compare ablation train finetune calibrate replay report reevaluate'
	@echo '                                                   evaluate video crosscheck bench'
	@echo '  PRESET=small     size of the search: paper, small  archive compare ablation'
	@echo '  ITERATIONS=N     stop after N iterations           archive compare ablation train finetune'
	@echo '  POLICY=SPEC      controller other than the shipped one: a checkpoint, a TorchScript or ONNX file,'
	@echo '                   file.py:callable, module:callable, or file.py:adapter@FILE for a file that'
	@echo '                   expects another observation       archive compare ablation finetune calibrate replay report reevaluate'
	@echo '                                                   evaluate video crosscheck'
	@echo '  SEED=N           seed of everything drawn          archive compare ablation train finetune calibrate replay reevaluate'
	@echo '                                                   evaluate video crosscheck bench'
	@echo '  RESUME=DIR       go on with this run               archive compare train finetune'
	@echo '  MIX=generated    terrains to train on beside hand-crafted ones: generated, hard-random, or hand-crafted'
	@echo '                   (nothing else)                    finetune'
	@echo '  DRAW=failing     draw the elites to train on by how often they were not crossed; uniform   finetune'
	@echo '  REWARDS="NAME=W"  other weights of reward terms than termination=-200 tracking_lin_vel=2  finetune'
	@echo '  TASK=commands    what robots are told in training: commands (random velocities); crossing (to cross)  finetune'
	@echo '  EXPORT=FILE      also write the controller there   train finetune'
	@echo '  METHOD=NAME      where terrains come from: cma_mae, cma_me, map_elites, directions, hard_random,'
	@echo '                   uniform_random, or several with +  archive'
	@echo '  INTERVALS=N      intervals of each ratio           archive'
	@echo '  WITHOUT="A B"    penalties to leave out            archive'
	@echo '  REPRODUCE=yes    evaluate elites again at the end: yes, no; auto: of preset paper  archive'
	@echo '  RUN=DIR          which archive; the newest one of ROBOT under runs/, else the published one, if left out'
	@echo '                                                   replay report view reevaluate video export'
	@echo '  ELITE=N          which elite of it, 0 the worst    replay view video export'
	@echo '                   (video, export, and of GENES crosscheck: or several, ELITE="0 3", or ELITE=all)'
	@echo '  POLICIES="base=shipped C-G=FILE"   controllers of the tables or the page, each NAME=SPEC   evaluate view'
	@echo '  ARCHIVE=DIR      run of a search: elites to train on, and those held out to evaluate on   finetune evaluate'
	@echo '  SPLIT_SEED=N     which elites are held out         finetune evaluate'
	@echo '  SETS="A B"       hand_crafted, hard_random, generated, generated_far               evaluate'
	@echo '  TERRAINS=N EPISODES=N   terrains a set, episodes a terrain                         evaluate report'
	@echo '                   (TERRAINS: calibrate too)'
	@echo '  TERRAIN=FILE     cross a heightmap of your own: an .npz with heights (rows along y) [m], or a .png of'
	@echo '                   8 or 16 bits seen from above      evaluate video'
	@echo '  SIZE="X Y" SCALE=M OFFSET=M   of that map: metres along x and y; a gray level; gray level 0; those of'
	@echo '                   its file, or of a .json beside it, if left out                     evaluate video'
	@echo '  RECORDING=FILE   film this instead of crossing     video'
	@echo '  FORMATS="A B"    of npz, png, xml, stl; all        export'
	@echo '  TABLES=FILE      tables of make evaluate to show; results/ROBOT/tables.json         report'
	@echo '  PORT=N HOST=ADDRESS   where the page is served: port 8080 for this machine alone      view'
	@echo '  OUT=FILE         where to write the numbers        compare ablation calibrate report evaluate crosscheck bench'
	@echo '                   or figure, film, folder           replay video export'
	@echo '  GENES=FILE       an archive.npz to take terrains from, ELITE= by number; hard-random ones if left out crosscheck'
	@echo '  FINE=both        who resolves contacts: neither, mujoco, both; neither if left out      crosscheck'
	@echo '  WORKERS=auto     Ray workers, one a GPU or CPU core: a number, or auto for all; a running cluster is'
	@echo '                   joined by RAY_ADDRESS             archive compare ablation calibrate reevaluate evaluate'
	@echo '  WORKER_LIMIT_S=S give a worker up that gets no further for so many seconds         archive compare reevaluate'
	@echo '  PROCESSES=N      processes on the CPU without Ray  archive compare reevaluate'
	@echo '  PYTHON=python3   interpreter .venv is made from (3.11 or newer)'
	@echo '  TORCH=SPEC       torch other than the pinned one, e.g. a build for your GPU driver: a requirement or a wheel'
	@echo 'All flags of a command: .venv/bin/python -m qd.search --help (or qd.show.replay, train.base, ...)'

setup: $(STAMP) ## Make .venv with the pinned packages, unless it is up to date

$(STAMP): pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { \
	  echo "make setup: PYTHON=$(PYTHON) must be Python 3.11 or newer, got: $$($(PYTHON) --version 2>&1)." >&2; \
	  echo 'Name another one: make setup PYTHON=python3.12' >&2; exit 1; }
	@echo 'Installing the pinned packages into .venv: some minutes the first time.'
	test -x $(BIN)/python || $(PYTHON) -m venv .venv
	grep -v $(if $(TORCH),'^torch==','^$$') constraints.txt > .venv/constraints.txt
	$(if $(TORCH),$(BIN)/python -m pip install '$(TORCH)')
	$(BIN)/python -m pip install --quiet -e '.[dev,cluster]' -c .venv/constraints.txt
	@touch $@

stand: setup ## Look at ROBOT: its joints and geoms, whether it stands, what lying on rough ground takes
	$(BIN)/python -m sim.robots.stand --robot $(call quoted,$(ROBOT)) $(call flags,DEVICE SEED)

archive: setup ## Search the terrains on which the controller of ROBOT fails; writes a run under runs/
	$(BIN)/python -m qd.search --robot $(call quoted,$(ROBOT)) $(call flags,PRESET DEVICE ITERATIONS POLICY SEED RESUME WORKERS PROCESSES WORKER_LIMIT_S METHOD INTERVALS WITHOUT REPRODUCE)

compare: setup ## Let the search and its baselines loose on the same number of terrains
	$(BIN)/python -m qd.studies.compare --robot $(call quoted,$(ROBOT)) $(call flags,PRESET DEVICE ITERATIONS POLICY SEED RESUME WORKERS PROCESSES WORKER_LIMIT_S OUT)

ablation: setup ## Search with and without the standard deviations in the fitness
	$(BIN)/python -m qd.studies.ablation --robot $(call quoted,$(ROBOT)) $(call flags,RUN PRESET DEVICE ITERATIONS POLICY SEED WORKERS OUT)

train: setup ## Train the base controller of ROBOT from scratch
	$(BIN)/python -m train.base --robot $(call quoted,$(ROBOT)) $(call flags,DEVICE ITERATIONS SEED RESUME EXPORT)

finetune: setup ## Train the controller of ROBOT further, on the terrains of an archive that broke it
	$(BIN)/python -m train.finetune --robot $(call quoted,$(ROBOT)) $(call flags,MIX ARCHIVE SPLIT_SEED POLICY DRAW REWARDS TASK DEVICE ITERATIONS SEED RESUME EXPORT)

calibrate: setup ## Measure the penalty scales of ROBOT
	$(BIN)/python -m qd.studies.calibrate --robot $(call quoted,$(ROBOT)) $(call flags,DEVICE POLICY TERRAINS SEED OUT WORKERS)

replay: setup ## Print elite ELITE=N of an archive and draw its terrain with the robot's paths
	$(BIN)/python -m qd.show.replay --robot $(call quoted,$(ROBOT)) $(call flags,RUN ELITE DEVICE POLICY SEED OUT)

report: setup ## Write one HTML page about an archive: how the controller breaks, on which terrains, in figures
	$(BIN)/python -m qd.show.report --robot $(call quoted,$(ROBOT)) $(call flags,RUN TABLES OUT DEVICE POLICY EPISODES)

view: setup ## Show an archive in the browser: its elites, their terrains, and the robot that crosses them
	$(BIN)/python -m qd.show.view --robot $(call quoted,$(ROBOT)) $(call flags,RUN POLICIES ELITE PORT HOST)

reevaluate: setup ## Evaluate every elite of an archive again with 40 fresh episodes
	$(BIN)/python -m qd.reevaluate --robot $(call quoted,$(ROBOT)) $(call flags,RUN DEVICE POLICY SEED WORKERS PROCESSES WORKER_LIMIT_S)

NO_MAP := POLICIES ARCHIVE SPLIT_SEED SETS TERRAINS WORKERS# what says nothing of one map and one controller
refused = $(if $(TERRAIN),$(strip $(foreach name,$(NO_MAP),$(if $($(name)),$(name)))))

evaluate: setup ## Rates of the controller of ROBOT; with TERRAIN on a map of yours, with POLICIES or ARCHIVE the paper's tables
	$(if $(refused),$(error make evaluate TERRAIN=FILE crosses one map with one controller, got $(refused) too: leave out one or the other, or name the controller with POLICY=FILE))
	$(BIN)/python -m $(if $(TERRAIN),qd.show.cross,train.evaluate.evaluate) --robot $(call quoted,$(ROBOT)) $(call flags,$(if $(TERRAIN),TERRAIN SIZE SCALE OFFSET DEVICE POLICY EPISODES SEED OUT,DEVICE POLICY POLICIES ARCHIVE SPLIT_SEED SETS TERRAINS EPISODES SEED OUT WORKERS))

video: setup ## Film the robot on elite ELITE=N of an archive, or on TERRAIN=FILE
	$(BIN)/python -m qd.show.video --robot $(call quoted,$(ROBOT)) $(call flags,RUN ELITE TERRAIN SIZE SCALE OFFSET RECORDING DEVICE POLICY SEED OUT)

export: setup ## Write elites as npz, 16-bit PNG, MJCF and STL: ELITE=N or ELITE=all
	$(BIN)/python -m qd.show.export --robot $(call quoted,$(ROBOT)) $(call flags,RUN ELITE OUT FORMATS)

tables: setup ## Write the published numbers, with the paper's beside them, into the README
	$(BIN)/python -m train.evaluate.publish

crosscheck: setup ## Hold the crossings of ROBOT against the same in plain MuJoCo C
	$(BIN)/python -m sim.mujoco_c.crosscheck --robot $(call quoted,$(ROBOT)) $(call flags,DEVICE POLICY SEED GENES ELITE FINE OUT)

bench: setup ## Time every kernel against torch and against what the device can do at best
	$(BIN)/python -m sim.bench --robot $(call quoted,$(ROBOT)) $(call flags,DEVICE SEED OUT)

test: setup ## Run the tests
	$(BIN)/python -m pytest

lint: setup ## Check style, documentation and types
	$(BIN)/ruff check .
	$(BIN)/pyright

clean: ## Remove caches and build leftovers; keeps .venv and runs/
	rm -rf .pytest_cache .ruff_cache build *.egg-info
	find kernels sim qd train tests -name __pycache__ -type d -prune -exec rm -rf {} +
